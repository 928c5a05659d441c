//! `structure.curve`: a line or curve of 3D Slicer, which becomes a tube before parsing, so a
//! [`Scene`](crate::Scene) holds its points, and so do its copies in the session and in the log.

use std::path::Path;

use markups::{Kind, Markup, read as read_markups};
use toml::{Table, Value};

use crate::check::Checker;
use crate::error::SceneError;
use crate::named_file::{ReadText, numbers, tables, take_text};

const KEY: [&str; 2] = ["structure.curve", "file"];

/// Replaces each `curve` in a scene's structures by a `tube`. Returns whether there was a `curve`.
///
/// # Errors
/// A file cannot be read or holds no curve, or a structure has both a `curve` and a `tube`.
pub(crate) fn put_in(
    scene: &mut Table,
    folder: &Path,
    read: &ReadText,
    checker: &Checker,
) -> Result<bool, SceneError> {
    let mut found = false;
    for structure in tables(scene, "structure") {
        let Some(Value::Table(curve)) = structure.get_mut("curve") else { continue };
        let Some(named) = take_text(curve, KEY, "a path", checker)? else { continue };
        let points = points_mm(&folder.join(named), read)
            .map_err(|problem| checker.invalid("structure.curve.file", problem))?;
        curve.insert("points_mm".to_owned(), Value::Array(points.into_iter().map(numbers).collect()));
        let tube = structure.remove("curve");
        if tube.and_then(|tube| structure.insert("tube".to_owned(), tube)).is_some() {
            return Err(checker.invalid("structure.curve", "and `tube` are mutually exclusive; set only one"));
        }
        found = true;
    }
    Ok(found)
}

/// Returns the control points of the only line or curve of a file; those of a closed curve end where they
/// begin.
fn points_mm(file: &Path, read: &ReadText) -> Result<Vec<[f64; 3]>, String> {
    let name = foreign_text::foreign_path(file);
    let text = read(file).map_err(|cause| format!("{name}: cannot be read ({cause})"))?;
    let markups = read_markups(&text).map_err(|cause| format!("{name}: {cause}"))?;
    let [Markup { kind, points, .. }] = &markups[..] else {
        return Err(format!("{name}: has {} markups; expected one line or curve", markups.len()));
    };
    let is_closed = *kind == Kind::Other("ClosedCurve".to_owned());
    if !is_closed && !matches!(kind, Kind::Line | Kind::Curve) {
        return Err(format!("{name}: is not a line, curve or closed curve"));
    }
    let placed: Option<Vec<[f64; 3]>> = points.iter().map(|point| point.position_mm).collect();
    let mut placed = placed
        .filter(|placed| placed.len() > 1)
        .ok_or_else(|| format!("{name}: has fewer than two control points, or one without a position"))?;
    if is_closed {
        placed.push(placed[0]);
    }
    Ok(placed)
}
