//! The pose format of Ultralytics: <https://docs.ultralytics.com/datasets/pose/>. A line for each class in a frame: class, box and keypoints,
//! as fractions of the image's width and height from its upper left edge. Only the tool has keypoints; those of the others are 0.

use std::fmt::Write as _;
use std::path::PathBuf;

use xray::{Class, Visibility};

use super::{Dataset, DatasetFile, Sample, bounds, grey8};

impl Dataset {
    pub(super) fn add_yolo(&mut self, sample: &Sample) -> Result<Vec<DatasetFile>, String> {
        let (labels, name) = (&sample.labels, sample.name());
        let png = grey8(labels.columns, labels.rows, sample.greys.iter().copied())?;
        let text: String = Class::ALL.into_iter().filter_map(|class| line(sample, class)).collect();
        self.images.push(name.clone());
        Ok(vec![
            (PathBuf::from("images").join(format!("{name}.png")), png),
            (PathBuf::from("labels").join(format!("{name}.txt")), text.into_bytes()),
        ])
    }

    pub(super) fn end_yolo(self) -> DatasetFile {
        let count = self.keypoints.len();
        let same: Vec<usize> = (0..count).collect();
        let mut text = format!(
            "# X-ray frames of Trabecula; bone from {} HU. Keypoints: {}\ntrain: images\nval: images\n\
             kpt_shape: [{count}, 3]\n# A mirrored tool keeps the order of its joints.\nflip_idx: {same:?}\nnames:\n",
            self.bone_from_hu,
            self.keypoints.join(", ")
        );
        for class in Class::ALL {
            // Writing to a string cannot fail.
            let _ = writeln!(text, "  {}: {}", class as u8, class.name());
        }
        (PathBuf::from("data.yaml"), text.into_bytes())
    }
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
