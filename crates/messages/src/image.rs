use super::{ControllerIndex, Pose};
use crate::message;

message! {
    /// A C-arm: point source, flat detector, pixel grid. Pixel (0, 0) is at the top left, as on a screen.
    pub struct CArmGeometry = "trabecula_msgs/msg/CArmGeometry" {
        /// Focal spot, world frame.
        source_m: [f64; 3],
        /// Centre of the detector, world frame.
        detector_centre_m: [f64; 3],
        /// Unit vector along a row, towards increasing column numbers, world frame.
        row_axis: [f64; 3],
        /// Unit vector along a column, towards increasing row numbers (down in the image), world frame.
        column_axis: [f64; 3],
        /// Distance between pixel centres along a row and along a column.
        pixel_pitch_m: [f64; 2],
        /// Number of pixel columns.
        columns: u32,
        /// Number of pixel rows.
        rows: u32,
    }
}

message! {
    /// The same C-arm as a camera and as DICOM positioner angles. Camera: s (u, v, 1) = K (R x + t), z
    /// towards the detector, pixel centres at integers (OpenCV); fx is negative if the image is seen from the
    /// detector's side.
    pub struct CArmProjection = "trabecula_msgs/msg/CArmProjection" {
        /// K in pixels, row-major.
        intrinsics: [f64; 9],
        /// R, row-major: the rows are the camera's axes in the world frame.
        rotation: [f64; 9],
        /// t: the world origin in the camera frame.
        translation_m: [f64; 3],
        /// DICOM (0018,1510): at 0 the detector is in front of the chest; positive towards the patient's
        /// left.
        primary_angle_rad: f64,
        /// DICOM (0018,1511): positive is cranial.
        secondary_angle_rad: f64,
        /// DICOM (0018,1110): distance from source to detector, along the detector's normal.
        source_detector_m: f64,
        /// DICOM (0018,1111): distance from source to the scene's isocentre, along the detector's normal.
        source_isocentre_m: f64,
    }
}

message! {
    /// Requests a frame.
    pub struct DrrRequest = "trabecula_msgs/msg/DrrRequest" {
        /// Chosen by the sender, from 1, and returned in the reply and the frame.
        request_id: u64,
        /// Earliest tick that the frame may show; 0 selects the newest.
        tick: u64,
        /// Index of the requesting controller in the scene.
        requester: u32,
        /// 0 the scene's C-arm, 1 `geometry`.
        use_geometry: u32,
        /// C-arm of this frame.
        geometry: CArmGeometry,
    }
}

impl DrrRequest {
    /// Returns the [`DrrRequest::requester`] value of this sender: a controller, or any other program.
    pub fn requester_of(sender: Option<ControllerIndex>) -> u32 {
        sender.map_or(u32::MAX, |controller| controller.0)
    }
}

message! {
    /// Announces which tick a frame will show, before it is rendered. Sent for every frame, requested or
    /// scheduled.
    pub struct DrrReply = "trabecula_msgs/msg/DrrReply" {
        /// The request's id; 0 for a scheduled frame.
        request_id: u64,
        /// `Frame.sequence` of the frame that follows.
        frame_sequence: u64,
        /// Tick that the frame shows.
        tick: u64,
        /// 0 accepted, 1 refused, 2 busy.
        status: u32,
        /// Index of the requesting controller.
        requester: u32,
        /// C-arm of the frame.
        geometry: CArmGeometry,
    }
}

message! {
    /// A frame's geometry and content; on the wire, an [`ImagePrefix`] and the pixels follow.
    pub struct Frame = "trabecula_msgs/msg/Frame" {
        /// Sequence number of the frames: 1, 2, 3 and so on.
        sequence: u64,
        /// The request's id; 0 for a scheduled frame.
        request_id: u64,
        /// Tick whose state the frame shows.
        tick: u64,
        /// Number of drilled voxels missing in the frame.
        removed_total: u64,
        /// Simulated time of that tick.
        sim_time_s: f64,
        /// XXH3-128 of the pixel bytes, low word first.
        pixel_hash: [u64; 2],
        /// Seed of the quantum noise.
        noise_seed: u64,
        /// Pose of the burr in this state: burr centre, axes of the last link.
        t_world_burr: Pose,
        /// C-arm of the frame.
        geometry: CArmGeometry,
        /// The same C-arm as a camera and as positioner angles.
        projection: CArmProjection,
    }
}

message! {
    /// The fixed part of a sensor_msgs/msg/Image with frame `c_arm_0` and encoding `mono16`. From here on,
    /// the bytes are that message's CDR body.
    pub struct ImagePrefix = "trabecula_msgs/msg/ImagePrefix" {
        /// Simulated time, seconds part.
        stamp_sec: i32,
        /// Simulated time, nanoseconds part.
        stamp_nanosec: u32,
        /// 8: length of the frame name including its NUL.
        frame_id_length: u32,
        /// `c_arm_0` and a NUL.
        frame_id: [u8; 8],
        /// Pixel rows.
        height: u32,
        /// Pixel columns.
        width: u32,
        /// 7: length of the encoding including its NUL.
        encoding_length: u32,
        /// `mono16` and a NUL.
        encoding: [u8; 7],
        /// 0: little-endian.
        is_bigendian: u8,
        /// Bytes per row.
        step: u32,
        /// Total bytes of pixels.
        data_length: u32,
    }
    tail data: [u8] = "uint8"
}

/// `ros2msg` schema of sensor_msgs/msg/Image; [`ImagePrefix`] has its layout.
pub const SENSOR_MSGS_IMAGE_SCHEMA: &str = "\
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";

impl ImagePrefix {
    /// Creates the prefix of a `mono16` image of `columns` × `rows` pixels at a simulated time.
    pub fn mono16(columns: u32, rows: u32, sim_time_s: f64) -> ImagePrefix {
        let nanoseconds = libm_round(sim_time_s * 1e9);
        ImagePrefix {
            stamp_sec: (nanoseconds / 1_000_000_000) as i32,
            stamp_nanosec: (nanoseconds % 1_000_000_000) as u32,
            frame_id_length: 8,
            frame_id: *b"c_arm_0\0",
            height: rows,
            width: columns,
            encoding_length: 7,
            encoding: *b"mono16\0",
            is_bigendian: 0,
            step: columns * 2,
            data_length: columns * rows * 2,
        }
    }
}

fn libm_round(value: f64) -> u64 {
    (value + 0.5) as u64
}
