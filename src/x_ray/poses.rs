//! Poses of the C-arm from TOML, JSON and CSV files: the keys of a scene's `[drr]` and `[drr.carm]`.

use std::path::Path;

use foreign_text::number;
use ipc_types::scene::{CArm as CameraOrPoints, Display, Drr, PixelCentre, Projector};
use serde::Deserialize;
use xray::CArm;
use xray::from_scene::scene_c_arm;

use crate::failure::Failure;
use crate::feasibility::in_millimetres;

/// A pose. Missing values come from the command line.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Pose {
    /// DICOM Positioner Primary Angle (0018,1510): LAO positive.
    pub primary_angle_deg: Option<f64>,
    /// DICOM Positioner Secondary Angle (0018,1511): cranial positive.
    pub secondary_angle_deg: Option<f64>,
    /// DICOM Distance Source to Patient (0018,1111).
    pub source_isocentre_mm: Option<f64>,
    /// DICOM Distance Source to Detector (0018,1110).
    pub source_detector_mm: Option<f64>,
    pub isocentre_mm: Option<[f64; 3]>,
    /// For a camera instead of angles: its matrix K, in pixels.
    pub intrinsics: Option<[[f64; 3]; 3]>,
    /// Rows: the camera's axes in the volume's frame.
    pub rotation: Option<[[f64; 3]; 3]>,
    /// Position of the volume's origin in the camera's frame.
    pub translation_mm: Option<[f64; 3]>,
    /// Position of a pixel's centre.
    pub pixel_centre: Option<PixelCentre>,
    /// For explicit source and detector positions instead: the focal spot.
    pub source_mm: Option<[f64; 3]>,
    /// The detector's centre.
    pub detector_centre_mm: Option<[f64; 3]>,
    /// Unit vector along a row.
    pub row_axis: Option<[f64; 3]>,
    /// Unit vector along a column.
    pub column_axis: Option<[f64; 3]>,
    pub columns: Option<u32>,
    pub rows: Option<u32>,
    /// Distance between pixel centres.
    pub pixel_pitch_mm: Option<f64>,
}

/// A file with a `pose` list.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct PoseList {
    pose: Vec<Pose>,
}

/// A C-arm and the isocentre that its angles refer to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ResolvedPose {
    pub c_arm: CArm,
    pub isocentre_m: [f64; 3],
}

impl Pose {
    /// Returns this pose with missing values taken from another.
    pub fn or(&self, other: &Pose) -> Pose {
        Pose {
            primary_angle_deg: self.primary_angle_deg.or(other.primary_angle_deg),
            secondary_angle_deg: self.secondary_angle_deg.or(other.secondary_angle_deg),
            source_isocentre_mm: self.source_isocentre_mm.or(other.source_isocentre_mm),
            source_detector_mm: self.source_detector_mm.or(other.source_detector_mm),
            isocentre_mm: self.isocentre_mm.or(other.isocentre_mm),
            columns: self.columns.or(other.columns),
            rows: self.rows.or(other.rows),
            pixel_pitch_mm: self.pixel_pitch_mm.or(other.pixel_pitch_mm),
            ..self.clone()
        }
    }

    /// Returns the first value present that only applies to a pose by C-arm angles.
    fn turned_by(&self) -> Option<&'static str> {
        [
            ("primary_angle_deg", self.primary_angle_deg),
            ("secondary_angle_deg", self.secondary_angle_deg),
            ("source_isocentre_mm", self.source_isocentre_mm),
            ("source_detector_mm", self.source_detector_mm),
        ]
        .into_iter()
        .find_map(|(key, value)| value.map(|_| key))
    }

    /// Returns whether the pose is a camera or points instead of angles.
    pub fn is_given(&self) -> bool {
        let camera = self.intrinsics.is_some() || self.rotation.is_some() || self.translation_mm.is_some();
        let axes = self.row_axis.is_some() || self.column_axis.is_some();
        camera || axes || self.source_mm.is_some() || self.detector_centre_mm.is_some()
    }

    /// Returns the C-arm; angles rotate about `centre_m` unless the pose has an isocentre.
    pub fn place(&self, centre_m: [f64; 3]) -> Result<ResolvedPose, String> {
        self.check_ranges()?;
        let isocentre_mm = self.isocentre_mm.unwrap_or(centre_m.map(|x| x * 1e3));
        let carm = self.is_given().then_some(CameraOrPoints {
            intrinsics: self.intrinsics,
            rotation: self.rotation,
            translation_mm: self.translation_mm,
            pixel_centre: self.pixel_centre,
            source_mm: self.source_mm,
            detector_centre_mm: self.detector_centre_mm,
            row_axis: self.row_axis,
            column_axis: self.column_axis,
        });
        let camera = self.intrinsics.is_some() && self.rotation.is_some() && self.translation_mm.is_some();
        let points = self.source_mm.is_some() && self.detector_centre_mm.is_some();
        let points = points && self.row_axis.is_some() && self.column_axis.is_some();
        if carm.is_some() && camera == points {
            return Err(
                "give either intrinsics, rotation and translation_mm, or source_mm, detector_centre_mm, \
                        row_axis and column_axis"
                    .to_owned(),
            );
        }
        if let Some(key) = self.turned_by().filter(|_| carm.is_some()) {
            return Err(format!(
                "`{key}` belongs to a pose by C-arm angles, but this pose is a camera or points; set only \
                 one kind"
            ));
        }
        let drr = Drr {
            rate_hz: 0.0,
            isocentre_mm,
            primary_angle_deg: self.primary_angle_deg.unwrap_or(0.0),
            secondary_angle_deg: self.secondary_angle_deg.unwrap_or(0.0),
            source_isocentre_mm: self.source_isocentre_mm.unwrap_or(SOURCE_ISOCENTRE_MM),
            source_detector_mm: self.source_detector_mm.unwrap_or(1000.0),
            columns: self.columns.unwrap_or(512),
            rows: self.rows.unwrap_or(512),
            pixel_pitch_mm: self.pixel_pitch_mm.unwrap_or(DEFAULT_PITCH_MM),
            energy_kev: 60.0,
            photons_per_pixel: 0.0,
            blur_pixels: 0.0,
            display: Display::BoneDark,
            detector: Default::default(),
            spectrum: None,
            scatter: None,
            grid: None,
            object: Vec::new(),
            carm,
            labels: None,
            notch: None,
            projector: Projector::SliceOrdered,
            oversampling: 1.0,
            reduction: 2,
            threads: 1,
        };
        let c_arm = scene_c_arm(&drr).map_err(in_millimetres)?;
        Ok(ResolvedPose { c_arm, isocentre_m: isocentre_mm.map(|x| x * 1e-3) })
    }
}

impl Pose {
    /// Checks each number in its file unit, because the renderer's errors are in radians and metres.
    fn check_ranges(&self) -> Result<(), String> {
        let isocentre_detector_mm = self.source_isocentre_mm.unwrap_or(SOURCE_ISOCENTRE_MM);
        let turn = (-180.0, 180.0);
        let (primary, secondary) = (self.primary_angle_deg, self.secondary_angle_deg);
        let numbers = [
            ("primary angle (`--primary-deg`, `primary_angle_deg`)", primary, "degrees", turn),
            ("secondary angle (`--secondary-deg`, `secondary_angle_deg`)", secondary, "degrees", turn),
            ("`source_isocentre_mm`", self.source_isocentre_mm, "mm", (1.0, 1e4)),
            ("`source_detector_mm`", self.source_detector_mm, "mm", (isocentre_detector_mm, 1e4)),
            ("`pixel_pitch_mm`", self.pixel_pitch_mm, "mm", (1e-3, LARGEST_PITCH_MM)),
        ];
        let points = [
            ("`isocentre_mm`", self.isocentre_mm),
            ("`translation_mm`", self.translation_mm),
            ("`source_mm`", self.source_mm),
            ("`detector_centre_mm`", self.detector_centre_mm),
        ];
        let each = |(name, point): (&'static str, Option<[f64; 3]>)| {
            point.into_iter().flatten().map(move |x| (name, Some(x), "mm", (-FURTHEST_MM, FURTHEST_MM)))
        };
        for (name, value, unit, (low, high)) in numbers.into_iter().chain(points.into_iter().flat_map(each)) {
            // Written so that NaN is rejected.
            if let Some(value) = value.filter(|value| !(low..=high).contains(value)) {
                let behind = if name.contains("detector_mm") {
                    " (the detector must be behind the isocentre)"
                } else {
                    ""
                };
                return Err(format!(
                    "{name} is {} {unit}; allowed: {low} to {high} {unit}{behind}",
                    number(value)
                ));
            }
        }
        Ok(())
    }
}

/// Pixel pitch of a pose that has none and does not frame the volume.
pub const DEFAULT_PITCH_MM: f64 = 0.6;
/// Largest pixel pitch.
pub const LARGEST_PITCH_MM: f64 = 100.0;
/// Default distance from source to isocentre.
const SOURCE_ISOCENTRE_MM: f64 = 700.0;
/// Largest coordinate.
const FURTHEST_MM: f64 = 1e5;

/// Reads the poses of a file: TOML or JSON (one table, or a `pose` list), or CSV with a header of scalar
/// keys.
///
/// # Errors
/// A file that cannot be read, has an unknown type or an unknown key (2).
pub fn read(path: &Path) -> Result<Vec<Pose>, Failure> {
    let bad = |cause: String| Failure::bad_input(format!("{}: {cause}", path.display()));
    let text = inputs::text::read(path)?;
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let poses = match extension {
        "csv" => csv(&text).map_err(bad)?,
        "json" => json(&text).map_err(|cause| bad(cause.to_string()))?,
        "toml" => toml(&text).map_err(|cause| bad(cause.to_string()))?,
        other => {
            return Err(bad(format!(
                "unknown file type {other:?}; expected a .toml, .json or .csv file of poses"
            )));
        }
    };
    if poses.is_empty() { Err(bad("no poses; expected at least one".to_owned())) } else { Ok(poses) }
}

// Inspected first instead of parsed as an untagged enum, whose error would not name the wrong key.
fn json(text: &str) -> Result<Vec<Pose>, serde_json::Error> {
    let table: serde_json::Map<String, serde_json::Value> = serde_json::from_str(text)?;
    if table.contains_key("pose") {
        return serde_json::from_str::<PoseList>(text).map(|list| list.pose);
    }
    serde_json::from_str(text).map(|pose| vec![pose])
}

fn toml(text: &str) -> Result<Vec<Pose>, toml::de::Error> {
    if toml::from_str::<toml::Table>(text)?.contains_key("pose") {
        return toml::from_str::<PoseList>(text).map(|list| list.pose);
    }
    toml::from_str(text).map(|pose| vec![pose])
}

fn csv(text: &str) -> Result<Vec<Pose>, String> {
    let mut lines = text.lines().map(str::trim).enumerate().filter(|(_, line)| !line.is_empty());
    let Some((first, header)) = lines.next() else { return Ok(Vec::new()) };
    let header: Vec<&str> = header.split(',').map(str::trim).collect();
    for (index, key) in header.iter().enumerate() {
        let cause = match set(&mut Pose::default(), key, "0") {
            Ok(()) if header[..index].contains(key) => format!("duplicate column `{key}`"),
            Ok(()) => continue,
            Err(cause) => cause,
        };
        return Err(format!("line {}: {cause}", first + 1));
    }
    lines
        .map(|(number, line)| {
            let values: Vec<&str> = line.split(',').map(str::trim).collect();
            if values.len() != header.len() {
                let (given, expected) = (values.len(), header.len());
                return Err(format!(
                    "line {}: {given} values, expected {expected} as in the header",
                    number + 1
                ));
            }
            let mut pose = Pose::default();
            for (key, value) in header.iter().zip(values) {
                set(&mut pose, key, value).map_err(|cause| format!("line {}: {cause}", number + 1))?;
            }
            Ok(pose)
        })
        .collect()
}

fn set(pose: &mut Pose, key: &str, value: &str) -> Result<(), String> {
    let number: f64 = value.parse().map_err(|_| format!("`{key}` is {value:?}, expected a number"))?;
    let field = match key {
        "primary_angle_deg" => &mut pose.primary_angle_deg,
        "secondary_angle_deg" => &mut pose.secondary_angle_deg,
        "source_isocentre_mm" => &mut pose.source_isocentre_mm,
        "source_detector_mm" => &mut pose.source_detector_mm,
        _ => {
            return Err(format!(
                "unknown column `{key}`; expected primary_angle_deg, secondary_angle_deg, \
                 source_isocentre_mm \
                 or source_detector_mm"
            ));
        }
    };
    *field = Some(number);
    Ok(())
}
