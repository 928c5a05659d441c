//! Ultralytics' formats for poses and for segmentation: <https://docs.ultralytics.com/datasets/pose/>,
//! <https://docs.ultralytics.com/datasets/segment/>. Places are fractions of the image's width and height from its upper left edge.
//!
//! Of a pose: a line for each class in a frame, with class, box and keypoints; only the tool has keypoints, those of the others are 0. Of a
//! segmentation: a line for each part of a class that hangs together, with class and corners of its outline.

use std::fmt::Write as _;
use std::path::PathBuf;

use xray::{Class, Visibility};

use super::outline::outlines;
use super::{Dataset, DatasetFile, Entry, Format, Part, Sample, bounds, grey8};

impl Dataset {
    pub(super) fn add_yolo(&mut self, sample: &Sample) -> Result<Vec<DatasetFile>, String> {
        let (labels, name, part) = (&sample.labels, self.name(sample), self.part(sample));
        let png = grey8(labels.columns, labels.rows, sample.greys.iter().copied())?;
        let text: String = match self.format {
            Format::YoloSeg => Class::ALL.into_iter().map(|class| lines_of_parts(sample, class)).collect(),
            _ => Class::ALL.into_iter().filter_map(|class| line(sample, class)).collect(),
        };
        self.images.push(Entry { part, json: name.clone() });
        let folder = |of: &str| PathBuf::from(of).join(part.map_or("", Part::name));
        Ok(vec![
            (folder("images").join(format!("{name}.png")), png),
            (folder("labels").join(format!("{name}.txt")), text.into_bytes()),
        ])
    }

    pub(super) fn end_yolo(self) -> DatasetFile {
        let mut text = format!("# X-ray frames of Trabecula; bone from {} HU.\n", self.bone_from_hu);
        for (number, run) in self.runs.iter().enumerate() {
            // Writing to a string cannot fail.
            let _ = writeln!(text, "# Run {}: {:?}", number + 1, run.log);
        }
        for part in self.parts() {
            let _ = match part {
                Some(part) => writeln!(text, "{0}: images/{0}", part.name()),
                None => writeln!(text, "train: images\nval: images"),
            };
        }
        if self.format == Format::Yolo {
            let count = self.keypoints.len();
            let same: Vec<usize> = (0..count).collect();
            let _ = writeln!(
                text,
                "# Keypoints: {}\nkpt_shape: [{count}, 3]\n# A mirrored tool keeps the order of its joints.\nflip_idx: {same:?}",
                self.keypoints.join(", ")
            );
        }
        text += "names:\n";
        for class in Class::ALL {
            let _ = writeln!(text, "  {}: {}", class as u8, class.name());
        }
        (PathBuf::from("data.yaml"), text.into_bytes())
    }
}

/// A line for each part of a class.
fn lines_of_parts(sample: &Sample, class: Class) -> String {
    let labels = &sample.labels;
    let mask: Vec<bool> = labels.of(class).collect();
    let mut lines = String::new();
    for outline in outlines(&mask, labels.columns as usize) {
        lines += &(class as u8).to_string();
        for [column, row] in outline {
            let [x, y] =
                [f64::from(column) / f64::from(labels.columns), f64::from(row) / f64::from(labels.rows)];
            let _ = write!(lines, " {x:.6} {y:.6}");
        }
        lines.push('\n');
    }
    lines
}

/// The line of a class; `None` if it is not in the frame.
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
                // From pixel centres at whole numbers to the image's edge.
                [(point.column + 0.5) / columns, (point.row + 0.5) / rows, f64::from(seen.code())]
            }
            _ => [0.0; 3],
        };
        let _ = write!(line, " {x:.6} {y:.6} {seen}");
    }
    Some(line + "\n")
}
