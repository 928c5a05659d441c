use super::Pose;
use crate::message;

/// [`DrrRequest::use_geometry`]: the scene's C-arm.
pub const GEOMETRY_SCENE: u32 = 0;
/// [`DrrRequest::use_geometry`]: the C-arm in [`DrrRequest::geometry`].
pub const GEOMETRY_REQUEST: u32 = 1;

message! {
    /// A C-arm: source point, flat detector, pixel grid. Pixel (0, 0) is top left, as on the screen.
    pub struct CArmGeometry = "trabecula_msgs/msg/CArmGeometry" {
        /// Focal spot, world.
        source_m: [f64; 3],
        /// Centre of the detector, world.
        detector_centre_m: [f64; 3],
        /// Unit vector along a row, towards growing column numbers, world.
        row_axis: [f64; 3],
        /// Unit vector along a column, towards growing row numbers (down in the picture), world.
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
    /// The same C-arm as others write it. Camera: s (u, v, 1) = K (R x + t), z towards the detector, pixel centres at
    /// whole numbers (OpenCV); fx is negative where the picture is seen from the detector's side.
    pub struct CArmProjection = "trabecula_msgs/msg/CArmProjection" {
        /// K in pixels, row by row.
        intrinsics: [f64; 9],
        /// R, row by row: rows are the camera's axes in the world.
        rotation: [f64; 9],
        /// t: the world's origin in the camera.
        translation_m: [f64; 3],
        /// DICOM (0018,1510): 0 is detector in front of the chest, positive towards the patient's left.
        primary_angle_rad: f64,
        /// DICOM (0018,1511): positive is cranial.
        secondary_angle_rad: f64,
        /// DICOM (0018,1110): source to detector, along its normal.
        source_detector_m: f64,
        /// DICOM (0018,1111): source to the scene's isocentre, along the detector's normal.
        source_isocentre_m: f64,
    }
}

message! {
    /// Asks for a frame.
    pub struct DrrRequest = "trabecula_msgs/msg/DrrRequest" {
        /// Chosen by the asker, from 1; comes back in the reply and the frame.
        request_id: u64,
        /// First tick whose state may be shown; 0 takes the newest.
        tick: u64,
        /// Index of the asking controller in the scene.
        requester: u32,
        /// 0 the scene's C-arm, 1 `geometry`.
        use_geometry: u32,
        /// C-arm of this frame.
        geometry: CArmGeometry,
    }
}

/// [`DrrReply::status`]: the frame follows.
pub const DRR_ACCEPTED: u32 = 0;
/// [`DrrReply::status`]: the geometry is not one; nothing follows.
pub const DRR_REFUSED: u32 = 1;
/// [`DrrReply::status`]: too many requests wait; nothing follows.
pub const DRR_BUSY: u32 = 2;

message! {
    /// Says which tick a frame will show, before it is rendered. One for every frame, asked for or scheduled.
    pub struct DrrReply = "trabecula_msgs/msg/DrrReply" {
        /// The request's id; 0 for a scheduled frame.
        request_id: u64,
        /// `Frame.sequence` of the frame that follows.
        frame_sequence: u64,
        /// Tick that it shows.
        tick: u64,
        /// 0 accepted, 1 refused, 2 busy.
        status: u32,
        /// Index of the controller that asked.
        requester: u32,
        /// C-arm of the frame.
        geometry: CArmGeometry,
    }
}

message! {
    /// What a frame shows; on the wire an [`ImagePrefix`] and the pixels follow.
    pub struct Frame = "trabecula_msgs/msg/Frame" {
        /// Counts the frames, from 1, rising by one.
        sequence: u64,
        /// The request's id; 0 for a scheduled frame.
        request_id: u64,
        /// Tick whose state it shows.
        tick: u64,
        /// Voxels gone in it.
        removed_total: u64,
        /// Simulated time of that tick.
        sim_time_s: f64,
        /// XXH3-128 of the pixel bytes, low word first.
        pixel_hash: [u64; 2],
        /// Seed of the quantum noise.
        noise_seed: u64,
        /// Burr centre in this state, axes of the last link.
        t_world_burr: Pose,
        /// C-arm of the frame.
        geometry: CArmGeometry,
        /// The same C-arm as camera and as positioner.
        projection: CArmProjection,
    }
}

message! {
    /// The fixed part of a sensor_msgs/msg/Image whose frame is `c_arm_0` and whose encoding is `mono16`: the bytes
    /// from here on are that message's CDR body.
    pub struct ImagePrefix = "trabecula_msgs/msg/ImagePrefix" {
        /// Seconds of the simulated time.
        stamp_sec: i32,
        /// Nanoseconds of the simulated time.
        stamp_nanosec: u32,
        /// 8: length of the frame name with its NUL.
        frame_id_length: u32,
        /// `c_arm_0` and a NUL.
        frame_id: [u8; 8],
        /// Pixel rows.
        height: u32,
        /// Pixel columns.
        width: u32,
        /// 7: length of the encoding with its NUL.
        encoding_length: u32,
        /// `mono16` and a NUL.
        encoding: [u8; 7],
        /// 0: little-endian.
        is_bigendian: u8,
        /// Bytes of a row.
        step: u32,
        /// Bytes of all pixels.
        data_length: u32,
    }
    tail data: [u8] = "uint8"
}

/// `ros2msg` schema of sensor_msgs/msg/Image, whose layout [`ImagePrefix`] has.
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
    /// The prefix of a `mono16` image of `columns` × `rows` pixels at a simulated time.
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
