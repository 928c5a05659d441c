//! Segmentations as 3D Slicer writes them (`.seg.nrrd`): segments by name, in one layer or several.
//!
//! Source: Slicer's developer guide, "Segmentations", `Segment<n>_Name`, `Segment<n>_LabelValue`,
//! `Segment<n>_Layer`.

use super::axes::Axes;
use super::header::Header;
use crate::error::VolumeError;
use crate::options::Label;

/// The voxels that were asked for.
pub(super) struct Wanted {
    /// Place along the axis of layers.
    pub layer: usize,
    /// Value inside.
    pub value: i16,
}

/// A segment as its header describes it.
struct Segment {
    name: String,
    layer: usize,
    value: i16,
}

/// Whether the header describes segments.
pub(super) fn are_in(header: &Header<'_>) -> bool {
    header.pairs.contains_key("Segment0_Name") || header.pairs.contains_key("Segment0_ID")
}

/// The voxels that the label means; `None` without a label.
pub(super) fn wanted(
    header: &Header<'_>,
    axes: &Axes,
    label: Option<&Label>,
    notes: &mut Vec<String>,
) -> Result<Option<Wanted>, VolumeError> {
    let segments = segments(header)?;
    let layers = axes.other.map_or(1, |other| other.size);
    let refuse =
        |given: String| VolumeError::NoSuchLabel { path: header.path.into(), given, there: names(&segments) };
    match label {
        None if layers > 1 => Err(refuse(format!("no label, and {layers} layers"))),
        None => {
            if !segments.is_empty() {
                notes.push(format!("a segmentation: {}", names(&segments)));
            }
            Ok(None)
        }
        Some(Label::Value(value)) if layers > 1 => {
            Err(refuse(format!("label {value}, which each of {layers} layers may have")))
        }
        Some(Label::Value(value)) => Ok(Some(Wanted { layer: 0, value: *value })),
        Some(Label::Name(name)) => {
            let mut found = segments.iter().filter(|segment| segment.name == *name);
            let Some(segment) = found.next() else { return Err(refuse(format!("label \"{name}\""))) };
            if found.next().is_some() {
                return Err(refuse(format!("label \"{name}\", which two segments have")));
            }
            if segment.layer >= layers {
                return Err(refuse(format!("label \"{name}\" in layer {} of {layers}", segment.layer)));
            }
            Ok(Some(Wanted { layer: segment.layer, value: segment.value }))
        }
    }
}

fn segments(header: &Header<'_>) -> Result<Vec<Segment>, VolumeError> {
    let mut out = Vec::new();
    for number in 0_usize.. {
        let field = |what: &str| format!("Segment{number}_{what}");
        let get = |what: &str| header.pairs.get(&field(what)).map(|text| text.trim());
        let Some(name) = get("Name").or_else(|| get("ID")) else { break };
        let whole = |what: &str, default: i16| match get(what) {
            None => Ok(default),
            Some(text) => text.parse::<i16>().ok().filter(|n| *n >= 0).ok_or_else(|| {
                crate::text_header::wrong(header.path, &field(what), text, "a whole number from 0 to 32767")
            }),
        };
        let layer = whole("Layer", 0)?;
        out.push(Segment { name: name.to_owned(), layer: layer as usize, value: whole("LabelValue", 1)? });
    }
    Ok(out)
}

/// The segments on one line.
fn names(segments: &[Segment]) -> String {
    if segments.is_empty() {
        return "no segment with a name".to_owned();
    }
    let each = |segment: &Segment| format!("\"{}\" ({})", segment.name, segment.value);
    segments.iter().map(each).collect::<Vec<_>>().join(", ")
}
