//! `sensor_msgs`.

use serde::{Deserialize, Serialize, Serializer};

use super::Header;

/// `sensor_msgs/msg/JointState`. Arrays are as long as `name`, or empty if nothing is known.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct JointState {
    /// Time; the frame is empty.
    pub header: Header,
    /// Names of the joints.
    pub name: Vec<String>,
    /// rad, or m for tendons.
    pub position: Vec<f64>,
    /// rad/s, or m/s for tendons.
    pub velocity: Vec<f64>,
    /// N m, or N for tendons.
    pub effort: Vec<f64>,
}

/// `sensor_msgs/msg/Image`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Image {
    /// Simulated time of the state that the image shows, and the camera's optical frame.
    pub header: Header,
    /// Rows.
    pub height: u32,
    /// Columns.
    pub width: u32,
    /// `mono16` or `mono8`.
    pub encoding: String,
    /// 0: little-endian.
    pub is_bigendian: u8,
    /// Bytes of a row.
    pub step: u32,
    /// Pixels, row by row from the top left; 0 is black.
    #[serde(serialize_with = "whole")]
    pub data: Vec<u8>,
}

/// `sensor_msgs/msg/PointField`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct PointField {
    /// Its name.
    pub name: String,
    /// Offset in a point, bytes.
    pub offset: u32,
    /// 7: float32, 6: uint32.
    pub datatype: u8,
    /// Number of elements.
    pub count: u32,
}

/// `sensor_msgs/msg/PointCloud2`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct PointCloud2 {
    /// Time and frame.
    pub header: Header,
    /// 1: an unordered cloud.
    pub height: u32,
    /// Number of points.
    pub width: u32,
    /// Fields of a point.
    pub fields: Vec<PointField>,
    /// False: little-endian.
    pub is_bigendian: bool,
    /// Bytes of a point.
    pub point_step: u32,
    /// Bytes of all points.
    pub row_step: u32,
    /// The points.
    #[serde(serialize_with = "whole")]
    pub data: Vec<u8>,
    /// Whether all points are valid.
    pub is_dense: bool,
}

/// Serializes in one piece: byte by byte is a hundred times as slow.
fn whole<S: Serializer>(data: &[u8], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_bytes(data)
}

/// `sensor_msgs/msg/RegionOfInterest`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct RegionOfInterest {
    /// Leftmost column.
    pub x_offset: u32,
    /// Topmost row.
    pub y_offset: u32,
    /// Rows; 0: all.
    pub height: u32,
    /// Columns; 0: all.
    pub width: u32,
    /// Whether it was rectified separately.
    pub do_rectify: bool,
}

/// `sensor_msgs/msg/CameraInfo`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CameraInfo {
    /// Same as the image's.
    pub header: Header,
    /// Rows.
    pub height: u32,
    /// Columns.
    pub width: u32,
    /// `plumb_bob`; a simulated C-arm has no distortion.
    pub distortion_model: String,
    /// The five distortion coefficients.
    pub d: Vec<f64>,
    /// K, row-major, pixels.
    pub k: [f64; 9],
    /// R, row-major: the identity.
    pub r: [f64; 9],
    /// P = (K | 0), row-major, pixels.
    pub p: [f64; 12],
    /// 0: no binning.
    pub binning_x: u32,
    /// 0: no binning.
    pub binning_y: u32,
    /// The whole image.
    pub roi: RegionOfInterest,
}
