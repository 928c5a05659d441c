//! `visualization_msgs`.

use serde::Serialize;

use super::{Header, RosPose, Time, Vector3};

/// `std_msgs/msg/ColorRGBA`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct ColorRgba {
    /// Red, 0 to 1.
    pub r: f32,
    /// Green.
    pub g: f32,
    /// Blue.
    pub b: f32,
    /// Opacity.
    pub a: f32,
}

/// `visualization_msgs/msg/Marker`, since Humble.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Marker {
    /// Time and frame.
    pub header: Header,
    /// Namespace of `id`.
    pub ns: String,
    /// A marker replaces the one with the same namespace and number.
    pub id: i32,
    /// 11: a list of triangles.
    pub kind: i32,
    /// 0: add or replace.
    pub action: i32,
    /// Pose of the points in the frame.
    pub pose: RosPose,
    /// Scale of the points.
    pub scale: Vector3,
    /// Colour.
    pub color: ColorRgba,
    /// Zero: until it is replaced. A `Duration` has the fields of a time.
    pub lifetime: Time,
    /// Whether it moves with its frame.
    pub frame_locked: bool,
    /// Three corners for each triangle.
    pub points: Vec<Vector3>,
    /// Empty: all have `color`.
    pub colors: Vec<ColorRgba>,
    /// Empty, like everything that follows.
    pub texture_resource: String,
    /// `sensor_msgs/msg/CompressedImage`.
    pub texture: (Header, String, Vec<u8>),
    /// Coordinates of the texture.
    pub uv_coordinates: Vec<[f32; 2]>,
    /// Text of a text marker.
    pub text: String,
    /// Mesh of a mesh marker.
    pub mesh_resource: String,
    /// `visualization_msgs/msg/MeshFile`.
    pub mesh_file: (String, Vec<u8>),
    /// Whether a mesh has its own materials.
    pub mesh_use_embedded_materials: bool,
}
