//! Encodes data sets of labelled frames; the caller writes the files.

mod coco;
pub mod lerobot;
mod npz;
mod outline;
mod split;
mod yolo;

use std::path::{Path, PathBuf};

use ipc_types::messages::{CArmProjection, Frame};
use ipc_types::scene::LabelImage;
use serde_json::{Value, json};
use xray::{Labels, Marker, keypoint_name};

pub use split::Split;

/// Format of a data set of labelled frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    Coco,
    Yolo,
    YoloSegment,
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

/// The run that frames belong to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Run {
    /// Number of the run, from 1; `None` for a single run.
    pub number: Option<usize>,
    /// Identity of the run: the hashes of its scene and volume.
    pub id: String,
    /// Part of the data set that contains it; 0 without a split.
    pub part: usize,
    /// Label images in `.npz` files.
    pub images: Vec<LabelImage>,
}

impl Run {
    /// Returns the base name of a frame's files.
    fn name_of(&self, sample: &Sample) -> String {
        let run = self.number.map(|number| format!("run_{number:04}_")).unwrap_or_default();
        format!("{run}frame_{:06}_tick_{:08}", sample.frame.sequence, sample.frame.tick)
    }
}

impl Sample {
    /// Returns camera, pose and markers of the frame: `rotation` and `translation_m` map world points to
    /// the camera frame, and `intrinsics` maps those to the image, with pixel centres at integers.
    fn pose(&self, run: &Run) -> Value {
        let CArmProjection { intrinsics, rotation, translation_m, .. } = self.frame.projection;
        let rows = |m: [f64; 9]| [[m[0], m[1], m[2]], [m[3], m[4], m[5]], [m[6], m[7], m[8]]];
        let burr = self.frame.t_world_burr;
        let mut pose = json!({
            "run": run.id,
            "tick": self.frame.tick,
            "sim_time_s": self.frame.sim_time_s,
            "camera": {
                "intrinsics": rows(intrinsics), "rotation": rows(rotation), "translation_m": translation_m,
            },
            "t_world_burr": {
                "position_m": burr.position_m, "orientation_xyzw": burr.orientation_xyzw,
            },
        });
        let marker = |Marker { name, centre_m, point }: &Marker| {
            json!({
                "name": name, "position_m": centre_m, "column": point.column, "row": point.row,
                "depth_m": point.depth_m, "visibility": point.visibility.code(),
            })
        };
        if !self.labels.markers.is_empty() {
            pose["markers"] = self.labels.markers.iter().map(marker).collect();
        }
        pose
    }
}

/// A file of a data set: its path in the folder, and its bytes.
pub type DatasetFile = (PathBuf, Vec<u8>);

/// A data set being built. Data about all frames is kept until the end.
#[derive(Debug)]
pub struct Dataset {
    format: Format,
    bone_from_hu: i16,
    /// Without a split there is a single unnamed part.
    parts: Vec<SplitData>,
    keypoints: Vec<String>,
}

/// Accumulated data of a part.
#[derive(Debug, Default)]
struct SplitData {
    name: Option<&'static str>,
    images: Vec<String>,
    annotations: Vec<String>,
}

impl SplitData {
    /// Returns the folder of the part, `of` itself without a split.
    fn folder(&self, of: &str) -> PathBuf {
        Path::new(of).join(self.name.unwrap_or_default())
    }
}

impl Dataset {
    /// Creates an empty data set.
    pub fn new(format: Format, bone_from_hu: i16, split: Option<&Split>) -> Dataset {
        let parts = match split {
            None => vec![SplitData::default()],
            Some(split) => split
                .names()
                .into_iter()
                .map(|name| SplitData { name: Some(name), ..SplitData::default() })
                .collect(),
        };
        Dataset { format, bone_from_hu, parts, keypoints: Vec::new() }
    }

    /// Returns the bone threshold of all frames.
    pub fn bone_from_hu(&self) -> i16 {
        self.bone_from_hu
    }

    /// Returns the number of frames.
    pub fn len(&self) -> usize {
        self.parts.iter().map(|part| part.images.len()).sum()
    }

    /// Returns whether there are no frames.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the number of frames by part; empty without a split.
    pub fn lengths(&self) -> Vec<(&'static str, usize)> {
        self.parts.iter().filter_map(|part| Some((part.name?, part.images.len()))).collect()
    }

    /// Adds a frame and returns its files.
    ///
    /// # Errors
    /// The joints differ from previous frames, or a file cannot be encoded; as text.
    pub fn add(&mut self, sample: &Sample, run: &Run) -> Result<Vec<DatasetFile>, String> {
        let count = sample.labels.keypoints.len();
        let keypoints: Vec<String> = (0..count).map(|index| keypoint_name(index, count)).collect();
        if self.is_empty() {
            self.keypoints = keypoints;
        } else if self.keypoints != keypoints {
            let before = self.keypoints.len();
            return Err(format!("the tool has {count} keypoints, expected {before} as in the previous runs"));
        }
        match self.format {
            Format::Coco => self.add_coco(sample, run),
            Format::Yolo | Format::YoloSegment => self.add_yolo(sample, run),
            Format::Npz => self.add_npz(sample, run),
        }
    }

    /// Returns the files about all frames, which are written last: without the last one a folder is
    /// incomplete.
    pub fn end(self) -> Vec<DatasetFile> {
        match self.format {
            Format::Coco => self.end_coco(),
            Format::Yolo | Format::YoloSegment => vec![self.end_yolo()],
            Format::Npz => vec![self.end_npz()],
        }
    }
}

/// Returns the bounding box of the true pixels (left, top, width, height), or `None` if all are false.
fn bounds(mask: impl Iterator<Item = bool>, columns: usize) -> Option<[usize; 4]> {
    let set = mask.enumerate().filter(|(_, set)| *set).map(|(i, _)| (i % columns, i / columns));
    let [left, top, right, bottom] = set.fold([usize::MAX, usize::MAX, 0, 0], |b, (column, row)| {
        [b[0].min(column), b[1].min(row), b[2].max(column + 1), b[3].max(row + 1)]
    });
    (right > left).then(|| [left, top, right - left, bottom - top])
}
