//! `trabecula cache`: shows and clears the cache of volumes and tool tables.

use std::path::{Path, PathBuf};
use std::time::SystemTime;

use clap::Subcommand;
use ipc_types::session::PlaceError;
use serde_json::json;

use crate::cache::{Cache, CachedFile, LIMIT_BYTES, place};
use crate::failure::Failure;
use crate::say::{Figures, path_text};

/// Arguments of `cache`.
#[derive(Debug, Subcommand)]
pub enum CacheCommand {
    /// Show the cache folder and the sizes of the cached volumes and tool tables.
    Info(Figures),
    /// Remove all cached volumes and tables; they are rebuilt when needed.
    Clear(Figures),
}

/// Runs the command.
///
/// # Errors
/// A folder that exists but cannot be used as a cache (2).
pub fn run(command: &CacheCommand) -> Result<(), Failure> {
    let (CacheCommand::Info(figures) | CacheCommand::Clear(figures)) = command;
    let path = place();
    let cache = path.as_deref().map(opened).transpose()?.flatten();
    match command {
        CacheCommand::Info(_) => info(path, cache.as_ref(), *figures),
        CacheCommand::Clear(_) => clear(cache.as_ref(), *figures),
    }
    Ok(())
}

/// Opens the cache, or returns `None` if it does not exist yet.
fn opened(path: &Path) -> Result<Option<Cache>, Failure> {
    match Cache::open_existing(path) {
        Ok(cache) => Ok(Some(cache)),
        Err(PlaceError::Missing | PlaceError::System(_)) => Ok(None),
        Err(cause) => Err(Failure::bad_input(format!(
            "{}: unusable as a cache: {cause}; make it a folder of mode 700 owned by you, or remove it",
            path.display()
        ))),
    }
}

fn info(path: Option<PathBuf>, cache: Option<&Cache>, figures: Figures) {
    let files = cache.map(Cache::files).unwrap_or_default();
    let bytes: u64 = files.iter().map(|file| file.bytes).sum();
    let (tables, volumes): (Vec<_>, Vec<_>) = files.iter().partition(|file| file.is_table());
    let text = || {
        let folder = match (&path, cache) {
            (None, _) => "none: neither XDG_CACHE_HOME nor HOME is an absolute path".to_owned(),
            (Some(path), None) => format!("{} (does not exist)", path.display()),
            (Some(path), Some(_)) => path.display().to_string(),
        };
        let lines = files.iter().map(|file| format!("\n  {}", line(file)));
        format!(
            "folder       {folder}\nvolumes      {}\ntables       {}\nbytes        {:.1} MB of at most \
             {:.0} MB{}",
            volumes.len(),
            tables.len(),
            bytes as f64 * 1e-6,
            LIMIT_BYTES as f64 * 1e-6,
            lines.collect::<String>()
        )
    };
    let listed = || {
        let file =
            |file: &&CachedFile| json!({"name": file.name, "bytes": file.bytes, "idle_s": idle_s(file)});
        let [volumes, tables] = [&volumes, &tables].map(|files| files.iter().map(file).collect::<Vec<_>>());
        let folder = path.as_deref().map(path_text);
        json!({
            "folder": folder, "bytes": bytes, "limit_bytes": LIMIT_BYTES, "volumes": volumes, "tables": tables,
        })
    };
    figures.say(text, listed);
}

fn line(file: &CachedFile) -> String {
    let name = file.name.get(..12).unwrap_or(&file.name);
    format!(
        "{name}  {:9.1} MB, last used {:.1} h ago",
        file.bytes as f64 * 1e-6,
        idle_s(file) as f64 / 3600.0
    )
}

fn idle_s(file: &CachedFile) -> u64 {
    SystemTime::now().duration_since(file.used).map_or(0, |idle| idle.as_secs())
}

fn clear(cache: Option<&Cache>, figures: Figures) {
    let tables = cache.map(Cache::files).unwrap_or_default().iter().filter(|file| file.is_table()).count();
    let (removed, bytes) = cache.map(Cache::clear).unwrap_or_default();
    let volumes = removed.saturating_sub(tables);
    figures.say(
        || format!("removed      {volumes} volumes, {tables} tables, {:.1} MB", bytes as f64 * 1e-6),
        || json!({"removed": removed, "bytes": bytes}),
    );
}
