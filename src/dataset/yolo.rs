//! Ultralytics formats, with one kind of label per file: for pose
//! (<https://docs.ultralytics.com/datasets/pose/>) one line per class in a frame with class, box and
//! keypoints; for segmentation (<https://docs.ultralytics.com/datasets/segment/>) one line per connected
//! component of a class with the vertices of its polygon. Coordinates are fractions of the image's width and
//! height from its upper left corner. Only the tool has keypoints; those of other classes are 0.

use std::fmt::Write as _;
use std::path::PathBuf;

use xray::{Class, Visibility};

use super::outline::polygons;
use super::{Dataset, DatasetFile, Format, Run, Sample, SplitData, bounds};
use figures::picture::grey8;

impl Dataset {
    pub(super) fn add_yolo(&mut self, sample: &Sample, run: &Run) -> Result<Vec<DatasetFile>, String> {
        let (labels, name) = (&sample.labels, run.name_of(sample));
        let png = grey8(labels.columns, labels.rows, sample.greys.iter().copied())?;
        let text: String = match self.format {
            Format::YoloSegment => Class::ALL.into_iter().map(|class| outlines(sample, class)).collect(),
            _ => Class::ALL.into_iter().filter_map(|class| line(sample, class)).collect(),
        };
        let part = &mut self.parts[run.part];
        part.images.push(name.clone());
        Ok(vec![
            (part.folder("images").join(format!("{name}.png")), png),
            (part.folder("labels").join(format!("{name}.txt")), text.into_bytes()),
        ])
    }

    pub(super) fn end_yolo(self) -> DatasetFile {
        let count = self.keypoints.len();
        let mut text = format!("# X-ray frames of Trabecula; bone from {} HU.\n", self.bone_from_hu);
        // Writing to a string cannot fail.
        match self.parts.as_slice() {
            [SplitData { name: None, .. }] => text.push_str("train: images\nval: images\n"),
            parts => parts.iter().filter_map(|part| part.name).for_each(|name| {
                let _ = writeln!(text, "{name}: images/{name}");
            }),
        }
        if self.format == Format::Yolo {
            let same: Vec<usize> = (0..count).collect();
            let names = self.keypoints.join(", ");
            let _ = write!(
                text,
                "# Keypoints: {names}\nkpt_shape: [{count}, 3]\n# A mirrored tool keeps the order of its \
                 joints.\nflip_idx: {same:?}\n"
            );
        }
        text.push_str("names:\n");
        for class in Class::ALL {
            let _ = writeln!(text, "  {}: {}", class as u8, class.name());
        }
        (PathBuf::from("data.yaml"), text.into_bytes())
    }
}

/// Formats the lines of a class, one polygon each.
fn outlines(sample: &Sample, class: Class) -> String {
    let (columns, rows) = (f64::from(sample.labels.columns), f64::from(sample.labels.rows));
    let mut lines = String::new();
    for mut polygon in polygons(sample.labels.of(class), sample.labels.columns as usize) {
        // A line with fewer than three vertices would be read as a box.
        while polygon.len() < 3 {
            polygon.extend(polygon.last().copied());
        }
        let _ = write!(lines, "{}", class as u8);
        for (column, row) in polygon {
            let [x, y] = [(f64::from(column) + 0.5) / columns, (f64::from(row) + 0.5) / rows];
            let _ = write!(lines, " {x:.6} {y:.6}");
        }
        lines.push('\n');
    }
    lines
}

/// Formats the line of a class, or returns `None` if it is not in the frame.
fn line(sample: &Sample, class: Class) -> Option<String> {
    let labels = &sample.labels;
    let [left, top, width, height] = bounds(labels.of(class), labels.columns as usize)?.map(|x| x as f64);
    let (columns, rows) = (f64::from(labels.columns), f64::from(labels.rows));
    let mut line = format!(
        "{} {:.6} {:.6} {:.6} {:.6}",
        class as u8,
        (left + 0.5 * width) / columns,
        (top + 0.5 * height) / rows,
        width / columns,
        height / rows
    );
    for point in &labels.keypoints {
        let [x, y, seen] = match point.visibility {
            seen if class == Class::Tool && seen != Visibility::Outside => {
                // From pixel centres at integers to the image's edge.
                [(point.column + 0.5) / columns, (point.row + 0.5) / rows, f64::from(seen.code())]
            }
            _ => [0.0; 3],
        };
        let _ = write!(line, " {x:.6} {y:.6} {seen}");
    }
    Some(line + "\n")
}
