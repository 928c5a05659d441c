//! Data sets of labelled frames: the bytes of their files. Writing them is the caller's.

mod coco;
mod npz;
mod outline;
mod picture;
mod split;
mod yolo;

use std::path::PathBuf;

use clap::ValueEnum;
use ipc_types::messages::{CArmProjection, Frame};
use serde_json::{Value, json};
use xray::Labels;
use xray::labels::keypoint_name;

pub use picture::{grey8, grey16};
pub use split::{Part, Shares};

/// Format of a data set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// `images/*.png` (16 bits) and `annotations.json` with masks, boxes and keypoints, as pycocotools reads it.
    Coco,
    /// `images/*.png` (8 bits), `labels/*.txt` with boxes and keypoints, and `data.yaml`, as Ultralytics reads it for pose estimation.
    Yolo,
    /// The same with the outlines of the classes' parts instead, as Ultralytics reads it for segmentation.
    YoloSeg,
    /// A NumPy `.npz` for each frame with the image and every label, and `dataset.json`.
    Npz,
}

/// A run whose frames a data set has.
#[derive(Debug, Clone)]
pub struct Run {
    /// Its log, as it was given.
    pub log: String,
    /// SHA-256 of its scene's text, in hexadecimal: runs of the same scene are the same run to a split.
    pub scene_sha256: String,
    /// The part of the data set that has its frames; none: it has no parts.
    pub part: Option<Part>,
}

/// A frame with its labels.
#[derive(Debug, Clone)]
pub struct Sample {
    /// Its run: the place in the data set's list.
    pub run: usize,
    /// Its metadata.
    pub frame: Frame,
    /// Greys, row-major from the top.
    pub greys: Vec<u16>,
    /// Its labels.
    pub labels: Labels,
}

impl Sample {
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

/// An image or annotation as JSON, and the part of the data set that it belongs to.
#[derive(Debug)]
struct Entry {
    part: Option<Part>,
    json: String,
}

/// A data set being made. What belongs to all frames is kept until its end.
#[derive(Debug)]
pub struct Dataset {
    format: Format,
    bone_from_hu: i16,
    runs: Vec<Run>,
    keypoints: Vec<String>,
    images: Vec<Entry>,
    annotations: Vec<Entry>,
}

impl Dataset {
    /// One of these runs, without frames yet.
    pub fn new(format: Format, bone_from_hu: i16, runs: Vec<Run>) -> Dataset {
        let (keypoints, images, annotations) = (Vec::new(), Vec::new(), Vec::new());
        Dataset { format, bone_from_hu, runs, keypoints, images, annotations }
    }

    /// Name of a frame's files without an ending; that of its run is in it where there are several.
    fn name(&self, sample: &Sample) -> String {
        let frame = format!("frame_{:06}_tick_{:08}", sample.frame.sequence, sample.frame.tick);
        if self.runs.len() > 1 { format!("run_{:04}_{frame}", sample.run + 1) } else { frame }
    }

    fn part(&self, sample: &Sample) -> Option<Part> {
        self.runs.get(sample.run).and_then(|run| run.part)
    }

    /// The data set's parts; `None` alone if it has none.
    fn parts(&self) -> Vec<Option<Part>> {
        let mut parts: Vec<_> = self.runs.iter().map(|run| run.part).collect();
        parts.sort_unstable();
        parts.dedup();
        parts
    }

    /// The runs as JSON, numbered from 1 as in the files' names.
    fn runs_json(&self) -> Value {
        let run = |(number, run): (usize, &Run)| {
            let part = run.part.map(Part::name);
            json!({"number": number + 1, "log": run.log, "scene_sha256": run.scene_sha256, "part": part})
        };
        self.runs.iter().enumerate().map(run).collect()
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
            Format::Yolo | Format::YoloSeg => self.add_yolo(sample),
            Format::Npz => self.add_npz(sample),
        }
    }

    /// The files about all frames. They are written last: a folder without them is not whole.
    pub fn end(self) -> Vec<DatasetFile> {
        match self.format {
            Format::Coco => self.end_coco(),
            Format::Yolo | Format::YoloSeg => vec![self.end_yolo()],
            Format::Npz => vec![self.end_npz()],
        }
    }
}

/// The entries of a part as the elements of a JSON list.
fn list(entries: &[Entry], part: Option<Part>) -> String {
    let own: Vec<&str> =
        entries.iter().filter(|entry| entry.part == part).map(|entry| &*entry.json).collect();
    own.join(",\n")
}

/// Smallest rectangle around the pixels that are true: left, top, width, height in pixels; `None` if none is.
fn bounds(mask: impl Iterator<Item = bool>, columns: usize) -> Option<[usize; 4]> {
    let set = mask.enumerate().filter(|(_, set)| *set).map(|(i, _)| (i % columns, i / columns));
    let [left, top, right, bottom] = set.fold([usize::MAX, usize::MAX, 0, 0], |b, (column, row)| {
        [b[0].min(column), b[1].min(row), b[2].max(column + 1), b[3].max(row + 1)]
    });
    (right > left).then(|| [left, top, right - left, bottom - top])
}
