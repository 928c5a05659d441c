//! Structures of the C ABI that are not messages: pointers into shared memory, and session facts.

use std::ffi::c_char;

use ipc_types::messages::{Event, Frame, Removed, Volume};

use super::CType;

views! {
    /// Constant properties of a session. The texts stay valid until trb_disconnect.
    struct SessionInfo = "trb_session_info" {
        /// Folder of the session.
        folder: *const c_char,
        /// Name of this client's controller; empty for an observer.
        controller: *const c_char,
        /// The complete scene as TOML.
        scene_toml: *const c_char,
        /// Simulated time of a tick.
        dt_s: f64,
        /// Number of ticks of the complete run.
        tick_count: u64,
        /// Ticks between two scheduled frames; 0 if there are none.
        frame_period_ticks: u64,
        /// Index of the controller in the scene; -1 for an observer.
        controller_index: i32,
        /// Number of the scene's controllers.
        controller_count: u32,
        /// 1 in lockstep (a tick waits for every controller), 0 in real time.
        lockstep: u32,
        /// Pixel columns of a frame; 0 without X-ray.
        frame_columns: u32,
        /// Pixel rows of a frame; 0 without X-ray.
        frame_rows: u32,
        /// 1 if there is a CT volume.
        has_volume: u32,
    }

    /// An X-ray frame in shared memory.
    struct FramePointers = "trb_frame_view" {
        /// Geometry and content of the frame.
        frame: *const Frame,
        /// Intensities, row after row from the top left; 0 is black.
        pixels: *const u16,
        /// Number of pixels.
        pixel_count: u64,
    }

    /// The CT volume in shared memory.
    struct VolumePointers = "trb_volume_view" {
        /// Geometry.
        volume: *const Volume,
        /// Hounsfield units, x varying fastest.
        hu: *const i16,
        /// Number of voxels.
        voxel_count: u64,
    }

    /// An event in shared memory.
    struct EventPointers = "trb_event_view" {
        /// The event.
        event: *const Event,
        /// Text of the event in UTF-8, with a final NUL.
        text: *const c_char,
    }

    /// Removed voxels in shared memory.
    struct RemovedPointers = "trb_removed_view" {
        /// The message.
        removed: *const Removed,
        /// Linear indices of the removed voxels (x varying fastest); removed->voxel_index_length of them.
        voxel_index: *const u32,
    }
}

c_types! {
    *mut SessionInfo => "trb_session_info *",
    *mut FramePointers => "trb_frame_view *",
    *mut VolumePointers => "trb_volume_view *",
    *mut EventPointers => "trb_event_view *",
    *mut RemovedPointers => "trb_removed_view *",
}
