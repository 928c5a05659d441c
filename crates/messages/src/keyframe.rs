use crate::message;

message! {
    /// One part of a keyframe. A keyframe saves everything that the physics keeps between ticks, so that a
    /// replay can start there. The bytes are written by `simulation::Simulation::write_keyframe` and are
    /// valid for one build only. Published after the state that they save.
    pub struct Keyframe = "trabecula_msgs/msg/Keyframe" {
        /// `State.tick` of the saved state.
        tick: u64,
        /// `State.hash` of the saved state, low word first.
        hash: [u64; 2],
        /// Sequence number of the parts, over all keyframes: 1, 2, 3 and so on.
        sequence: u64,
        /// Length of the whole keyframe in bytes.
        total_bytes: u32,
        /// Offset of this part in the keyframe.
        offset_bytes: u32,
        /// Always 0.
        reserved: u32,
        /// Length of this part in bytes.
        data_length: u32,
    }
    tail data: [u8] = "uint8"
}
