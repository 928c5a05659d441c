//! `.mrk.json`.

use serde_json::Value;

use crate::error::MarkupsError;
use crate::markup::{Frame, Kind, Markup, POSITION, Point, position};

const FRAME: &str =
    "\"LPS\" or \"RAS\": the frame of the positions is not assumed; save the markups again from 3D Slicer";
const MARKUPS: &str = "a list of one or more markups, as written by 3D Slicer";
const POINTS: &str = "a list of control points";

/// Reads a file's text.
pub(crate) fn read(text: &str) -> Result<Vec<Markup>, MarkupsError> {
    let file: Value =
        serde_json::from_str(text).map_err(|cause| MarkupsError::NotJson { cause: cause.to_string() })?;
    let markups = list(&file, "markups", "markups", MARKUPS)?;
    if markups.is_empty() {
        return Err(field("markups", &file["markups"], MARKUPS));
    }
    markups.iter().enumerate().map(|(index, given)| markup(given, &format!("markups[{index}]"))).collect()
}

fn markup(given: &Value, path: &str) -> Result<Markup, MarkupsError> {
    let of = |key: &str| format!("{path}.{key}");
    let kind = match text(given, "type", &of("type"), "text, such as \"Line\"")? {
        "Fiducial" => Kind::Points,
        "Line" => Kind::Line,
        "Curve" => Kind::Curve,
        other => Kind::Other(other.to_owned()),
    };
    let key = of("coordinateSystem");
    let named = text(given, "coordinateSystem", &key, FRAME)?;
    let frame = Frame::of_name(named).ok_or_else(|| field(&key, &given["coordinateSystem"], FRAME))?;
    check_unit(given, &of("coordinateUnits"))?;
    // Planes and regions of interest need no control points.
    let points = match &given["controlPoints"] {
        Value::Null if matches!(kind, Kind::Other(_)) => &[],
        _ => list(given, "controlPoints", &of("controlPoints"), POINTS)?,
    };
    let path = of("controlPoints");
    let points =
        points.iter().enumerate().map(|(index, given)| point(given, &format!("{path}[{index}]"), frame));
    Ok(Markup { kind, frame, points: points.collect::<Result<_, _>>()? })
}

/// Slicer writes `mm`, or the unit as a coded entry `["mm", "UCUM", "millimeter"]`.
fn check_unit(given: &Value, key: &str) -> Result<(), MarkupsError> {
    let unit = &given["coordinateUnits"];
    let is_mm = match unit {
        Value::Null => true,
        Value::Array(coded) => coded.first().is_some_and(|code| code == "mm"),
        unit => unit == "mm",
    };
    if is_mm { Ok(()) } else { Err(field(key, unit, "\"mm\"")) }
}

fn point(given: &Value, path: &str, frame: Frame) -> Result<Point, MarkupsError> {
    let of = |key: &str| format!("{path}.{key}");
    let label = match &given["label"] {
        Value::Null => "",
        _ => text(given, "label", &of("label"), "text")?,
    };
    let status = match &given["positionStatus"] {
        Value::Null => "defined",
        _ => text(given, "positionStatus", &of("positionStatus"), "text, such as \"defined\"")?,
    };
    let place = &given["position"];
    let position_mm = match (status, place) {
        ("defined", _) | (_, Value::Array(_)) => {
            if place.is_null() {
                return Err(MarkupsError::Missing { field: of("position"), expected: POSITION });
            }
            let numbers = three(place).and_then(|given| position(frame, given));
            Some(numbers.ok_or_else(|| field(&of("position"), place, POSITION))?)
        }
        _ => None,
    };
    let is_set = status == "defined";
    Ok(Point {
        label: label.to_owned(),
        position_mm: position_mm.filter(|_| is_set),
        status: status.to_owned(),
    })
}

fn three(place: &Value) -> Option<[f64; 3]> {
    let numbers: Option<Vec<f64>> = place.as_array()?.iter().map(Value::as_f64).collect();
    numbers?.try_into().ok()
}

fn list<'v>(
    given: &'v Value,
    key: &str,
    path: &str,
    expected: &'static str,
) -> Result<&'v [Value], MarkupsError> {
    match given.get(key) {
        Some(Value::Array(values)) => Ok(values),
        Some(other) => Err(field(path, other, expected)),
        None => Err(MarkupsError::Missing { field: path.to_owned(), expected }),
    }
}

fn text<'v>(
    given: &'v Value,
    key: &str,
    path: &str,
    expected: &'static str,
) -> Result<&'v str, MarkupsError> {
    match given.get(key) {
        Some(Value::String(text)) => Ok(text),
        Some(other) => Err(field(path, other, expected)),
        None => Err(MarkupsError::Missing { field: path.to_owned(), expected }),
    }
}

fn field(path: &str, given: &Value, expected: &'static str) -> MarkupsError {
    MarkupsError::Field { field: path.to_owned(), given: given.to_string(), expected }
}
