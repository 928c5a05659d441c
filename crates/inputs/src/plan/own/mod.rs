//! The table of a scene's own tool, measured on first use and cached.
//!
//! Only loads that occur in the scene are measured ([`cases::CaseGroup`]), each part cached separately under
//! the hash of the whole tool description, of the part and of this build. Costs are estimated
//! ([`candidates::cost`]), so the rows do not depend on the machine.

mod candidates;
mod cases;
mod measuring;
mod tool;

use std::time::{Duration, Instant};

use ipc_types::scene::{ContactVoxels, Scene};

use super::TABLE;
use super::load::{Load, Pull, is_standard_tool};
use super::measure::trials::larger;
use super::table::{OWN_LINKS, Row, Settings, read, write};
use crate::cache::text::TextKey;
use crate::cache::{Cache, place, remark};
use crate::failure::Failure;
use cases::CaseGroup;
pub use tool::OwnTool;

/// Version of the measuring method: part of a table's hash, besides the build.
const MEASURING: &str = "trabecula plan 1";
/// Interval of progress reports.
const SAID_EVERY: Duration = Duration::from_secs(2);

/// Measured errors of a tool.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    /// One row per settings.
    pub rows: Vec<Row>,
    /// The tool they were measured for; `None` for the standard one.
    pub tool: Option<String>,
}

impl Table {
    /// The built-in table of the standard tool.
    ///
    /// # Errors
    /// Never in a build that passes its tests.
    pub fn standard() -> Result<Table, Failure> {
        let rows = read(TABLE)
            .ok_or_else(|| Failure::failed("the built-in table of measured errors cannot be parsed"))?;
        Ok(Table { rows, tool: None })
    }

    /// Returns the table for a scene's tool, as far as the scene's loads require it: built in, cached, or
    /// measured now.
    ///
    /// # Errors
    /// Bad input: the tool cannot be measured.
    pub fn of(scene: &Scene) -> Result<Table, Failure> {
        if is_standard_tool(scene) {
            return Table::standard();
        }
        let opened = place().map(|path| Cache::open(&path).map_err(|cause| (path, cause)));
        let (cache, why) = match opened {
            Some(Ok(cache)) => (Some(cache), None),
            Some(Err((path, cause))) => (None, Some(format!("{}: {}", path.display(), cause))),
            None => (None, Some("neither XDG_CACHE_HOME nor HOME is an absolute path".to_owned())),
        };
        if let Some(why) = why {
            remark(&format!("the errors of tool `{}` cannot be cached: {why}", OwnTool::of(scene).name));
        }
        Table::own(scene, cache.as_ref())
    }

    /// The table of a non-standard tool.
    pub(super) fn own(scene: &Scene, cache: Option<&Cache>) -> Result<Table, Failure> {
        let tool = OwnTool::of(scene);
        let settings = settings(scene)?;
        let standard = Table::standard()?.rows;
        let mut rows: Vec<Row> = settings.iter().map(|it| unmeasured(it, &standard)).collect();
        for part in parts(scene) {
            for (row, measured) in rows.iter_mut().zip(kept_or_measured(&tool, part, &settings, cache)?) {
                match part {
                    CaseGroup::Gentle => {
                        (row.rest_mm, row.free_path_mm) = (measured.rest_mm, measured.free_path_mm);
                    }
                    CaseGroup::Bodies => {
                        row.rest_mm = larger(row.rest_mm, measured.rest_mm);
                        row.free_path_mm = larger(row.free_path_mm, measured.free_path_mm);
                    }
                    CaseGroup::Hard => {
                        (row.hard_rest_mm, row.hard_path_mm) = (measured.hard_rest_mm, measured.hard_path_mm);
                    }
                    CaseGroup::Bone => {
                        (row.drilled_path_mm, row.grid_path_mm) =
                            (measured.drilled_path_mm, measured.grid_path_mm);
                    }
                }
            }
        }
        Ok(Table { rows, tool: Some(tool.name) })
    }
}

/// The settings that are measured for a scene's own tool.
///
/// # Errors
/// Bad input: the tool cannot be measured.
pub(super) fn settings(scene: &Scene) -> Result<Vec<Settings>, Failure> {
    let tool = OwnTool::of(scene);
    candidates::settings(&tool)
}

fn parts(scene: &Scene) -> impl Iterator<Item = CaseGroup> {
    let load = Load::of(scene);
    let bodies = (!scene.body.is_empty()).then_some(CaseGroup::Bodies);
    let hard = (load.pull == Pull::Hard).then_some(CaseGroup::Hard);
    let bone = load.bone.then_some(CaseGroup::Bone);
    [Some(CaseGroup::Gentle), bodies, hard, bone].into_iter().flatten()
}

/// A row with the values that do not depend on the tool: its estimated costs, and how a sphere rests on a
/// wall of voxels.
fn unmeasured(settings: &Settings, standard: &[Row]) -> Row {
    let [free_us_per_ms, drilling_us_per_ms] = candidates::cost(settings, standard);
    let is_alike =
        |row: &&Row| row.settings.links == OWN_LINKS && row.settings.contact == ContactVoxels::Planes;
    let voxel_wall_mm = standard.iter().find(is_alike).map_or(f64::NAN, |row| row.voxel_wall_mm);
    Row { voxel_wall_mm, free_us_per_ms, drilling_us_per_ms, ..Row::unmeasured(*settings) }
}

/// The rows of a part, in the order of the settings.
fn kept_or_measured(
    tool: &OwnTool,
    part: CaseGroup,
    settings: &[Settings],
    cache: Option<&Cache>,
) -> Result<Vec<Row>, Failure> {
    let key = TextKey::of(&[MEASURING, part.name(), &tool.text()?]);
    if let Some(rows) = cache.and_then(|cache| kept(cache, key, settings)) {
        return Ok(rows);
    }
    let text = write(&measuring::measure(tool, part, settings, progress(tool, part))?);
    // A concurrent command may have been faster; its table is the same.
    let not_kept = |cache: &Cache| {
        let cause = cache.keep_text(key, &text).err()?;
        cache.find_text(key).ok().flatten().is_none().then_some(cause)
    };
    if let Some(cause) = cache.and_then(not_kept) {
        remark(&format!("the errors of tool `{}` cannot be cached: {cause}", tool.name));
    }
    // Parses the written text, so that this command uses the same digits as the next one.
    read(&text).ok_or_else(|| Failure::failed(format!("tool `{}`: its table cannot be read back", tool.name)))
}

fn kept(cache: &Cache, key: TextKey, settings: &[Settings]) -> Option<Vec<Row>> {
    let refused = |why: &str| {
        remark(&format!("{}: {why}; measuring it again", cache.path_of_text(key).display()));
        cache.remove_text(key);
        None
    };
    match cache.find_text(key) {
        Ok(None) => None,
        Ok(Some(text)) => match read(&text) {
            Some(rows) if rows.iter().map(|row| row.settings).eq(settings.iter().copied()) => Some(rows),
            _ => refused("not a table of these settings"),
        },
        Err(damage) => refused(&damage.to_string()),
    }
}

/// Reports the progress of measuring from time to time.
fn progress(tool: &OwnTool, part: CaseGroup) -> impl FnMut(usize, usize) {
    let what = match part {
        CaseGroup::Gentle => "in free space",
        CaseGroup::Bodies => "against a wall",
        CaseGroup::Hard => "under hard pulls",
        CaseGroup::Bone => "in bone",
    };
    let (name, mut said) = (tool.name.clone(), None::<Instant>);
    move |done, all| {
        if said.is_none_or(|said| said.elapsed() >= SAID_EVERY) && done < all {
            said = Some(Instant::now());
            remark(&format!("measuring the errors of tool `{name}` {what} (first use): {done} of {all}"));
        }
    }
}

#[cfg(test)]
mod tests;
