//! Data sets of labelled frames: the bytes of their files. Writing them is the caller's.

mod coco;
mod npz;
mod picture;
mod yolo;

use std::path::PathBuf;

use clap::ValueEnum;
use ipc_types::messages::{CArmProjection, Frame};
use serde_json::{Value, json};
use xray::Labels;
use xray::labels::keypoint_name;

pub use picture::{grey8, grey16};

/// Format of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// `images/*.png` (16 bits) and `annotations.json` with masks, boxes and keypoints, as pycocotools reads it.
    Coco,
    /// `images/*.png` (8 bits), `labels/*.txt` with boxes and keypoints, and `data.yaml`, as Ultralytics reads it for pose estimation.
    Yolo,
    /// A NumPy `.npz` for each frame with the image and every label, and `dataset.json`.
    Npz,
}

/// A frame with its labels.
#[derive(Debug, Clone)]
pub struct Sample {
    /// Its metadata.
    pub frame: Frame,
    /// Greys, row-major from the top.
    pub greys: Vec<u16>,
    /// Its labels.
    pub labels: Labels,
}

impl Sample {
    /// Name of its files without an ending.
    fn name(&self) -> String {
        format!("frame_{:06}_tick_{:08}", self.frame.sequence, self.frame.tick)
    }

    /// Camera and pose of the frame: world points go into the camera by `rotation` and `translation_m`, and into the image by
    /// `intrinsics`, with pixel centres at whole numbers.
    fn pose(&self) -> Value {
        let CArmProjection { intrinsics, rotation, translation_m, .. } = self.frame.projection;
        let rows = |m: [f64; 9]| [[m[0], m[1], m[2]], [m[3], m[4], m[5]], [m[6], m[7], m[8]]];
        let burr = self.frame.t_world_burr;
        json!({
            "tick": self.frame.tick,
            "sim_time_s": self.frame.sim_time_s,
            "camera": {
                "intrinsics": rows(intrinsics), "rotation": rows(rotation), "translation_m": translation_m,
            },
            "t_world_burr": {
                "position_m": burr.position_m, "orientation_xyzw": burr.orientation_xyzw,
            },
        })
    }
}

/// A file of a data set: its path in the folder, and its bytes.
pub type DatasetFile = (PathBuf, Vec<u8>);

/// A data set being made. What belongs to all frames is kept until its end.
#[derive(Debug)]
pub struct Dataset {
    format: Format,
    bone_from_hu: i16,
    keypoints: Vec<String>,
    images: Vec<String>,
    annotations: Vec<String>,
}

impl Dataset {
    /// An empty one.
    pub fn new(format: Format, bone_from_hu: i16) -> Dataset {
        let (keypoints, images, annotations) = (Vec::new(), Vec::new(), Vec::new());
        Dataset { format, bone_from_hu, keypoints, images, annotations }
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.images.len()
    }

    /// True without frames.
    pub fn is_empty(&self) -> bool {
        self.images.is_empty()
    }

    /// Takes a frame; the files of it alone.
    ///
    /// # Errors
    /// A file cannot be encoded, in words.
    pub fn add(&mut self, sample: &Sample) -> Result<Vec<DatasetFile>, String> {
        let count = sample.labels.keypoints.len();
        self.keypoints = (0..count).map(|index| keypoint_name(index, count)).collect();
        match self.format {
            Format::Coco => self.add_coco(sample),
            Format::Yolo => self.add_yolo(sample),
            Format::Npz => self.add_npz(sample),
        }
    }

    /// The file about all frames. It is written last: a folder without it is not whole.
    pub fn end(self) -> DatasetFile {
        match self.format {
            Format::Coco => self.end_coco(),
            Format::Yolo => self.end_yolo(),
            Format::Npz => self.end_npz(),
        }
    }
}

/// Smallest rectangle around the pixels that are true: left, top, width, height in pixels; `None` if none is.
fn bounds(mask: impl Iterator<Item = bool>, columns: usize) -> Option<[usize; 4]> {
    let set = mask.enumerate().filter(|(_, set)| *set).map(|(i, _)| (i % columns, i / columns));
    let [left, top, right, bottom] = set.fold([usize::MAX, usize::MAX, 0, 0], |b, (column, row)| {
        [b[0].min(column), b[1].min(row), b[2].max(column + 1), b[3].max(row + 1)]
    });
    (right > left).then(|| [left, top, right - left, bottom - top])
}
