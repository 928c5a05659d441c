//! COCO JSON, <https://cocodataset.org/#format-data>. Masks are uncompressed run lengths, so they are exact;
//! pixel centres are at integers for keypoints, pixel edges for boxes.

use std::path::PathBuf;

use serde_json::{Value, json};
use xray::{Class, Visibility};

use super::{Dataset, DatasetFile, Run, Sample, SplitData, bounds};
use figures::picture::grey16;

impl Dataset {
    pub(super) fn add_coco(&mut self, sample: &Sample, run: &Run) -> Result<Vec<DatasetFile>, String> {
        let labels = &sample.labels;
        let file_name = format!("{}.png", run.name_of(sample));
        let png = grey16(labels.columns, labels.rows, sample.greys.iter().copied())?;
        let part = &mut self.parts[run.part];
        let image_id = part.images.len() + 1;
        let mut image = sample.pose(run);
        image["id"] = json!(image_id);
        image["file_name"] = json!(file_name);
        image["width"] = json!(labels.columns);
        image["height"] = json!(labels.rows);
        part.images.push(image.to_string());
        for class in Class::ALL {
            if let Some(mut annotation) = annotation(sample, class) {
                annotation["id"] = json!(part.annotations.len() + 1);
                annotation["image_id"] = json!(image_id);
                part.annotations.push(annotation.to_string());
            }
        }
        Ok(vec![(PathBuf::from("images").join(file_name), png)])
    }

    /// Returns a file for each part.
    pub(super) fn end_coco(self) -> Vec<DatasetFile> {
        let info = json!({"description": "X-ray frames of Trabecula", "bone_from_hu": self.bone_from_hu});
        let categories = json!(Class::ALL.map(|class| category(class, &self.keypoints)));
        let file = |part: SplitData| {
            let (images, annotations) = (part.images.join(",\n"), part.annotations.join(",\n"));
            // The parts are already JSON.
            let text = format!(
                "{{\"info\":{info},\n\"categories\":{categories},\n\"images\":[\n{images}\n],\n\"annotations\":[\n{annotations}\n]}}\n"
            );
            let name =
                part.name.map_or("annotations.json".to_owned(), |name| format!("annotations_{name}.json"));
            (PathBuf::from(name), text.into_bytes())
        };
        self.parts.into_iter().map(file).collect()
    }
}

/// Category IDs start at 1.
fn category_id(class: Class) -> u8 {
    class as u8 + 1
}

fn category(class: Class, keypoints: &[String]) -> Value {
    let mut category = json!({"id": category_id(class), "name": class.name(), "supercategory": "x-ray"});
    if class == Class::Tool {
        // COCO counts keypoints from 1.
        let skeleton: Vec<[usize; 2]> = (1..keypoints.len()).map(|number| [number, number + 1]).collect();
        category["keypoints"] = json!(keypoints);
        category["skeleton"] = json!(skeleton);
    }
    category
}

/// Returns the annotation of a class in a frame, or `None` if absent.
fn annotation(sample: &Sample, class: Class) -> Option<Value> {
    let labels = &sample.labels;
    let (columns, rows) = (labels.columns as usize, labels.rows as usize);
    let box_px = bounds(labels.of(class), columns)?;
    let counts = run_lengths(&labels.mask, class, columns, rows);
    let area: usize = counts.iter().skip(1).step_by(2).sum();
    let mut annotation = json!({
        "category_id": category_id(class), "iscrowd": 0, "area": area, "bbox": box_px,
        "segmentation": {"size": [rows, columns], "counts": counts},
    });
    if class == Class::Tool {
        let seen = |visibility: Visibility| visibility != Visibility::Outside;
        let flat = labels.keypoints.iter().flat_map(|point| match seen(point.visibility) {
            true => [point.column, point.row, f64::from(point.visibility.code())],
            false => [0.0; 3],
        });
        annotation["keypoints"] = flat.collect();
        annotation["num_keypoints"] =
            json!(labels.keypoints.iter().filter(|point| seen(point.visibility)).count());
    }
    Some(annotation)
}

/// Returns the alternating run lengths of pixels without and with a class, column by column.
fn run_lengths(mask: &[u8], class: Class, columns: usize, rows: usize) -> Vec<usize> {
    let (mut counts, mut inside, mut run) = (Vec::new(), false, 0);
    for column in 0..columns {
        for bits in mask.iter().skip(column).step_by(columns).take(rows) {
            if (bits & class.bit() != 0) != inside {
                counts.push(run);
                (inside, run) = (!inside, 0);
            }
            run += 1;
        }
    }
    counts.push(run);
    counts
}
