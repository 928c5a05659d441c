//! 3D Slicer segmentations (`.seg.nrrd`): named segments, in one layer or several.
//!
//! Source: Slicer's developer guide, "Segmentations", `Segment<n>_Name`, `Segment<n>_LabelValue`,
//! `Segment<n>_Layer`.

use foreign_text::foreign;

use super::axes::Axes;
use super::header::Header;
use crate::error::VolumeError;
use crate::options::Label;

/// The requested voxels.
pub(super) struct SegmentSelection {
    /// Index along the layer axis.
    pub layer: usize,
    /// Voxel value inside.
    pub value: i16,
}

/// A segment as described in the header.
struct Segment {
    name: String,
    layer: usize,
    value: i16,
}

/// Whether the header describes segments.
pub(super) fn are_in(header: &Header<'_>) -> bool {
    header.pairs.contains_key("Segment0_Name") || header.pairs.contains_key("Segment0_ID")
}

/// Resolves the label to voxels; `None` without a label.
pub(super) fn wanted(
    header: &Header<'_>,
    axes: &Axes,
    label: Option<&Label>,
    notes: &mut Vec<String>,
) -> Result<Option<SegmentSelection>, VolumeError> {
    let layers = axes.other.map_or(1, |other| other.size);
    let segments = segments(header, layers)?;
    let refuse =
        |given: String| VolumeError::NoSuchLabel { path: header.path.into(), given, there: names(&segments) };
    match label {
        None if layers > 1 => Err(refuse(format!("no label selected, but there are {layers} layers"))),
        None => {
            if !segments.is_empty() {
                notes.push(format!("segmentation with {}", names(&segments)));
            }
            Ok(None)
        }
        Some(Label::Value(value)) if layers > 1 => {
            Err(refuse(format!("label {value} is ambiguous: there are {layers} layers")))
        }
        Some(Label::Value(value)) => Ok(Some(SegmentSelection { layer: 0, value: *value })),
        Some(Label::Name(name)) => {
            let mut found = segments.iter().filter(|segment| segment.name == *name);
            let Some(segment) = found.next() else {
                return Err(refuse(format!("label \"{name}\" not found")));
            };
            if found.next().is_some() {
                return Err(refuse(format!("label \"{name}\" is ambiguous: two segments have this name")));
            }
            if segment.layer >= layers {
                return Err(refuse(format!(
                    "label \"{name}\" is in layer {}, but there are only {layers} layers",
                    segment.layer
                )));
            }
            Ok(Some(SegmentSelection { layer: segment.layer, value: segment.value }))
        }
    }
}

/// The segments of a file with `layers` layers. Slicer before 4.11 gave each segment a layer of its own and
/// wrote no `Segment<n>_Layer`; Slicer still reads the index as the layer (`vtkMRMLSegmentationStorageNode`).
fn segments(header: &Header<'_>, layers: usize) -> Result<Vec<Segment>, VolumeError> {
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
        let layer = match get("Layer") {
            None if layers > 1 => number,
            _ => whole("Layer", 0)? as usize,
        };
        out.push(Segment { name: name.to_owned(), layer, value: whole("LabelValue", 1)? });
    }
    Ok(out)
}

/// Largest number of segments listed; a segmentation of a whole body has about a hundred.
const MOST_LISTED: usize = 120;

/// The first segments on one line, with their names cut to a bounded length.
fn names(segments: &[Segment]) -> String {
    if segments.is_empty() {
        return "no named segments".to_owned();
    }
    let each = |segment: &Segment| format!("\"{}\" ({})", foreign(&segment.name), segment.value);
    let listed = segments.iter().take(MOST_LISTED).map(each).collect::<Vec<_>>().join(", ");
    match segments.len().saturating_sub(MOST_LISTED) {
        0 => listed,
        more => format!("{listed} and {more} more"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Regression: a file with 20,000 segments filled the terminal.
    #[test]
    fn a_list_of_segments_from_a_file_has_a_bounded_length() {
        let segment = |name: String| Segment { name, layer: 0, value: 1 };
        let few = names(&[segment("femur".to_owned()), segment("pelvis".to_owned())]);
        assert_eq!(few, "\"femur\" (1), \"pelvis\" (1)");
        let long = names(&[segment("x".repeat(300))]);
        assert_eq!(long, format!("\"{}… (100 more characters)\" (1)", "x".repeat(200)));
        let many: Vec<Segment> = (0..20_000).map(|number| segment(format!("segment {number}"))).collect();
        let listed = names(&many);
        assert!(listed.ends_with("\"segment 119\" (1) and 19880 more") && listed.len() < 4096, "{listed}");
    }
}
