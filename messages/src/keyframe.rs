use crate::message;

message! {
    /// A part of a keyframe: everything that the physics keeps between ticks, so that a replay can begin here. The bytes
    /// are the physics' own (`simulation::Simulation::write_keyframe`) and belong to one build. Published behind the
    /// state that they save.
    pub struct Keyframe = "trabecula_msgs/msg/Keyframe" {
        /// `State.tick` of that state.
        tick: u64,
        /// `State.hash` of that state, low word first.
        hash: [u64; 2],
        /// Counts the parts of all keyframes, from 1, rising by one.
        sequence: u64,
        /// Length of the whole keyframe in bytes.
        total_bytes: u32,
        /// Where this part begins in it.
        offset_bytes: u32,
        /// Always 0.
        reserved: u32,
        /// Bytes of this part.
        data_length: u32,
    }
    tail data: [u8] = "uint8"
}
