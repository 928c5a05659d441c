//! Measured files: named columns of CSV, Parquet, MCAP and rosbag2, streamed.
//!
//! Only the requested columns are kept. A missing value is NaN; a value that is not a number is an error that
//! names its row.

mod csv;
mod mcap;
mod parquet;

use std::fs::{File, OpenOptions};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use foreign_text::{foreign, foreign_path, nearest_name};
use identify::signal::Rows;
use identify::study::Source;
use identify::unit::Dimension;

use crate::failure::Failure;

/// Maximum number of rows of a measured file.
pub const MAX_ROWS: usize = 10_000_000;

/// Reads the rows of a source: its time in seconds, and a column for each name. An empty name gives a
/// column of missing values.
///
/// # Errors
/// Bad input: the file cannot be read, is of an unknown kind, lacks a column, or holds no number where one is
/// expected.
pub fn read(source: &Source, columns: &[String]) -> Result<Rows, Failure> {
    let file = &source.file;
    let ending = file.extension().map(|ending| ending.to_string_lossy().to_lowercase());
    let mut wanted: Vec<&str> = source.time.iter().map(String::as_str).collect();
    let first = wanted.len();
    wanted.extend(columns.iter().map(String::as_str).filter(|name| !name.is_empty()));
    let unit_s = Dimension::Time.size_of(&source.time_unit).map_err(Failure::bad_input)?;
    let (times_s, read) = match ending.as_deref() {
        Some("csv" | "tsv" | "txt") => timed(csv::read(file, &wanted)?, unit_s),
        Some("parquet") => timed(parquet::read(file, &wanted)?, unit_s),
        _ => {
            let topic = source.topic.as_deref().unwrap_or_default();
            let rows = mcap::read(file, topic, source.time.as_deref(), &wanted[first..])?;
            (rows.times_s, rows.columns)
        }
    };
    let mut read = read.into_iter();
    let columns = columns.iter().map(|name| match name.is_empty() {
        true => vec![f64::NAN; times_s.len()],
        false => read.next().unwrap_or_default(),
    });
    Ok(Rows { columns: columns.collect(), times_s })
}

/// Takes the time, the first column, in seconds.
fn timed(mut columns: Vec<Vec<f64>>, unit_s: f64) -> (Vec<f64>, Vec<Vec<f64>>) {
    let times = columns.remove(0);
    (times.into_iter().map(|time| time * unit_s).collect(), columns)
}

/// Opens a regular file.
fn opened(file: &Path) -> Result<File, Failure> {
    let cannot = |cause: &dyn std::fmt::Display| {
        Failure::bad_input(format!("{}: cannot be read ({cause})", foreign_path(file)))
    };
    let found =
        OpenOptions::new().read(true).custom_flags(rustix::fs::OFlags::NONBLOCK.bits() as i32).open(file);
    let found = found.map_err(|cause| cannot(&cause))?;
    match found.metadata().map_err(|cause| cannot(&cause))?.is_file() {
        true => Ok(found),
        false => Err(cannot(&"not a regular file")),
    }
}

/// Error of a column that a file does not have.
fn no_column(file: &Path, name: &str, known: &[&str]) -> Failure {
    let near = nearest_name(name, known.iter().copied());
    let near = near.map_or(String::new(), |near| format!(" (did you mean `{}`?)", foreign(near)));
    let listed: Vec<String> = known.iter().take(40).map(|name| foreign(name).to_string()).collect();
    Failure::bad_input(format!(
        "{}: no column `{}`{near}; it has {}",
        foreign_path(file),
        foreign(name),
        listed.join(", ")
    ))
}

/// Error of too many rows.
fn too_long(file: &Path) -> Failure {
    Failure::bad_input(format!("{}: more than {MAX_ROWS} rows", foreign_path(file)))
}

/// Advice for a bag of rosbag2 in SQLite: a database only to read it would double what measured files need.
const SQLITE: &str = "a bag in SQLite; convert it with `ros2 bag convert` to the storage `mcap`";

/// Returns the MCAP files of a path: itself, or those of a rosbag2 folder in the order of their names.
fn mcap_files(path: &Path) -> Result<Vec<PathBuf>, Failure> {
    let is = |file: &Path, ending: &str| file.extension().is_some_and(|found| found == ending);
    let refused = |why: &str| Err(Failure::bad_input(format!("{}: {why}", foreign_path(path))));
    if is(path, "db3") {
        return refused(SQLITE);
    }
    if is(path, "bag") {
        return refused("a bag of ROS 1; convert it to MCAP with ROS 2 messages");
    }
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let entries = std::fs::read_dir(path)
        .map_err(|cause| Failure::bad_input(format!("{}: cannot be read ({cause})", foreign_path(path))))?;
    let mut files: Vec<PathBuf> = entries.flatten().map(|entry| entry.path()).collect();
    files.sort();
    let has_sqlite = files.iter().any(|file| is(file, "db3"));
    files.retain(|file| is(file, "mcap"));
    if files.is_empty() {
        return refused(if has_sqlite { SQLITE } else { "expected a folder with .mcap files" });
    }
    Ok(files)
}

#[cfg(test)]
mod tests;
