//! Data sets of labelled frames: the bytes of their files. Writing them is the caller's.

mod coco;
mod npz;
mod outline;
mod split;
mod yolo;

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use ipc_types::messages::{CArmProjection, Frame};
use ipc_types::scene::LabelImage;
use serde_json::{Value, json};
use xray::{Labels, keypoint_name};

pub use split::Split;

/// Format of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// `images/*.png` (16 bits) and `annotations.json` with masks, boxes and keypoints, as pycocotools reads
    /// it.
    Coco,
    /// `images/*.png` (8 bits), `labels/*.txt` with boxes and keypoints, and `data.yaml`, as Ultralytics
    /// reads it for pose estimation.
    Yolo,
    /// The same with polygons of the masks in `labels/*.txt`, as Ultralytics reads it for segmentation.
    YoloSegment,
    /// A NumPy `.npz` for each frame with the image and every label, and `dataset.json`.
    Npz,
}

/// A frame with its labels.
#[derive(Debug, Clone)]
pub struct Sample {
    pub frame: Frame,
    /// Greys, row-major from the top.
    pub greys: Vec<u16>,
    pub labels: Labels,
}

/// The run that frames are of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Run {
    /// Its number among several, from 1; none of one alone.
    pub number: Option<usize>,
    /// What tells runs apart: the hashes of their scenes and volumes.
    pub id: String,
    /// The part of the data set that has it; 0 without a split.
    pub part: usize,
    /// Images of its labels in `.npz` files.
    pub images: Vec<LabelImage>,
}

impl Run {
    /// Name of the files of a frame without an ending.
    fn name_of(&self, sample: &Sample) -> String {
        let run = self.number.map(|number| format!("run_{number:04}_")).unwrap_or_default();
        format!("{run}frame_{:06}_tick_{:08}", sample.frame.sequence, sample.frame.tick)
    }
}

impl Sample {
    /// Camera and pose of the frame: world points go into the camera by `rotation` and `translation_m`, and
    /// into the image by `intrinsics`, with pixel centres at whole numbers.
    fn pose(&self, run: &Run) -> Value {
        let CArmProjection { intrinsics, rotation, translation_m, .. } = self.frame.projection;
        let rows = |m: [f64; 9]| [[m[0], m[1], m[2]], [m[3], m[4], m[5]], [m[6], m[7], m[8]]];
        let burr = self.frame.t_world_burr;
        json!({
            "run": run.id,
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
    /// Without a split there is one part, of no name.
    parts: Vec<Part>,
    keypoints: Vec<String>,
}

/// What is kept of a part.
#[derive(Debug, Default)]
struct Part {
    name: Option<&'static str>,
    images: Vec<String>,
    annotations: Vec<String>,
}

impl Part {
    /// A folder of the part: `of` itself without a split.
    fn folder(&self, of: &str) -> PathBuf {
        Path::new(of).join(self.name.unwrap_or_default())
    }
}

impl Dataset {
    /// An empty one.
    pub fn new(format: Format, bone_from_hu: i16, split: Option<&Split>) -> Dataset {
        let parts = match split {
            None => vec![Part::default()],
            Some(split) => {
                split.names().into_iter().map(|name| Part { name: Some(name), ..Part::default() }).collect()
            }
        };
        Dataset { format, bone_from_hu, parts, keypoints: Vec::new() }
    }

    /// Voxels at or above this are bone in all frames.
    pub fn bone_from_hu(&self) -> i16 {
        self.bone_from_hu
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.parts.iter().map(|part| part.images.len()).sum()
    }

    /// True without frames.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Number of frames by part; empty without a split.
    pub fn lengths(&self) -> Vec<(&'static str, usize)> {
        self.parts.iter().filter_map(|part| Some((part.name?, part.images.len()))).collect()
    }

    /// Takes a frame; the files of it alone.
    ///
    /// # Errors
    /// The tool has other joints than in the frames before; a file cannot be encoded; in words.
    pub fn add(&mut self, sample: &Sample, run: &Run) -> Result<Vec<DatasetFile>, String> {
        let count = sample.labels.keypoints.len();
        let keypoints: Vec<String> = (0..count).map(|index| keypoint_name(index, count)).collect();
        if self.is_empty() {
            self.keypoints = keypoints;
        } else if self.keypoints != keypoints {
            let before = self.keypoints.len();
            return Err(format!("the tool has {count} keypoints, expected the {before} of the runs before"));
        }
        match self.format {
            Format::Coco => self.add_coco(sample, run),
            Format::Yolo | Format::YoloSegment => self.add_yolo(sample, run),
            Format::Npz => self.add_npz(sample, run),
        }
    }

    /// The files about all frames. They are written last: a folder without the last of them is not whole.
    pub fn end(self) -> Vec<DatasetFile> {
        match self.format {
            Format::Coco => self.end_coco(),
            Format::Yolo | Format::YoloSegment => vec![self.end_yolo()],
            Format::Npz => vec![self.end_npz()],
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
