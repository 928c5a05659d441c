//! Writes a log for viewers, derived from a run's log: the `/tf` poses and the scene that the 3D panels of
//! Lichtblick, Foxglove and RViz draw, beside messages of the log. It contains no run header, so no command
//! mistakes it for a run's log.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use mcap::write::NoSeek;
use mcap::{Compression, McapError, WriteOptions, Writer};
use messages::Pose;
use messages::layout::{CDR_LITTLE_ENDIAN, Description};

use crate::error::LogError;
use crate::library::LIBRARY;
use crate::sink::PROFILE;
use crate::topics;

/// Topic of the poses.
pub const TF: &str = "/tf";
/// Schema name of [`TF`].
const TF_SCHEMA_NAME: &str = "tf2_msgs/msg/TFMessage";
/// ROS 2's definitions of the message and of those in it (`tf2_msgs`, `geometry_msgs`, `std_msgs`,
/// `builtin_interfaces`, Jazzy).
const TF_SCHEMA: &str = "geometry_msgs/TransformStamped[] transforms
================================================================================
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x 0
float64 y 0
float64 z 0
float64 w 1
";
/// Schema name of scenes; `foxglove.SceneUpdate` is known to the viewers by this name.
const SCENE_SCHEMA_NAME: &str = "foxglove.SceneUpdate";
/// A chunk is closed once it holds this many bytes.
const CHUNK_BYTES: usize = 4 << 20;

/// A log for viewers being written.
pub struct ViewerLog<W: Write> {
    writer: Writer<NoSeek<W>>,
    path: PathBuf,
    /// Channel and messages so far, by topic.
    channels: BTreeMap<String, (u16, u64)>,
    chunk_bytes: usize,
}

impl<W: Write> ViewerLog<W> {
    /// Writes the start of a log to `out`; errors will name `path`.
    ///
    /// # Errors
    /// [`LogError::Write`].
    pub fn create(out: W, path: &Path) -> Result<ViewerLog<W>, LogError> {
        // Only our own code decides where chunks end, so that the bytes depend on the calls alone.
        let options =
            WriteOptions::new().library(LIBRARY).profile(PROFILE).chunk_size(None).disable_seeking(true);
        let options = options.compression(Some(Compression::Lz4)).compression_level(0).compression_threads(0);
        let writer = options.create(NoSeek::new(out)).map_err(|error| failed(path, error))?;
        Ok(ViewerLog { writer, path: path.into(), channels: BTreeMap::new(), chunk_bytes: 0 })
    }

    /// Writes poses: parent, child, and the child's pose in its parent, in metres.
    ///
    /// # Errors
    /// [`LogError::Write`].
    pub fn transforms(&mut self, time_ns: u64, poses: &[(&str, &str, &Pose)]) -> Result<(), LogError> {
        let schema = (TF_SCHEMA_NAME, "ros2msg", TF_SCHEMA.as_bytes());
        self.write(TF, schema, "cdr", time_ns, &tf_message(time_ns, poses))
    }

    /// Writes a `foxglove.SceneUpdate` in JSON.
    ///
    /// # Errors
    /// [`LogError::Write`].
    pub fn scene(&mut self, topic: &str, time_ns: u64, update: &str) -> Result<(), LogError> {
        let schema = (SCENE_SCHEMA_NAME, "jsonschema", b"{\"type\":\"object\",\"properties\":{}}".as_slice());
        self.write(topic, schema, "json", time_ns, update.as_bytes())
    }

    /// Copies a message of a log.
    ///
    /// # Errors
    /// [`LogError::Write`].
    pub fn message(
        &mut self,
        topic: &str,
        description: &'static Description,
        time_ns: u64,
        body: &[u8],
    ) -> Result<(), LogError> {
        let (name, text) = topics::schema_of(description);
        let mut bytes = CDR_LITTLE_ENDIAN.to_vec();
        bytes.extend_from_slice(body);
        self.write(topic, (name, "ros2msg", text.as_bytes()), "cdr", time_ns, &bytes)
    }

    fn write(
        &mut self,
        topic: &str,
        (name, encoding, text): (&str, &str, &[u8]),
        message_encoding: &str,
        time_ns: u64,
        bytes: &[u8],
    ) -> Result<(), LogError> {
        let path = &self.path;
        let fail = |error| failed(path, error);
        if !self.channels.contains_key(topic) {
            let schema = self.writer.add_schema(name, encoding, text).map_err(fail)?;
            let channel = self.writer.add_channel(schema, topic, message_encoding, &BTreeMap::new());
            self.channels.insert(topic.to_owned(), (channel.map_err(fail)?, 0));
        }
        let Some((channel_id, count)) = self.channels.get_mut(topic) else { return Ok(()) };
        let header = MessageHeader {
            channel_id: *channel_id,
            sequence: *count as u32,
            log_time: time_ns,
            publish_time: time_ns,
        };
        self.writer.write_to_known_channel(&header, bytes).map_err(fail)?;
        *count += 1;
        self.chunk_bytes += bytes.len();
        if self.chunk_bytes >= CHUNK_BYTES {
            self.chunk_bytes = 0;
            self.writer.flush().map_err(fail)?;
        }
        Ok(())
    }

    /// Writes the index and the footer, and returns the output.
    ///
    /// # Errors
    /// [`LogError::Write`].
    pub fn finish(mut self) -> Result<W, LogError> {
        self.writer.finish().map_err(|error| failed(&self.path, error))?;
        let mut written = self.writer.into_inner().into_inner();
        written.flush().map_err(|source| LogError::Write { path: self.path, source })?;
        Ok(written)
    }
}

fn failed(path: &Path, error: McapError) -> LogError {
    match error {
        McapError::Io(source) => LogError::Write { path: path.into(), source },
        source => LogError::Encode { path: path.into(), source },
    }
}

/// `tf2_msgs/msg/TFMessage` in CDR.
fn tf_message(time_ns: u64, poses: &[(&str, &str, &Pose)]) -> Vec<u8> {
    let mut cdr = Cdr(Vec::new());
    cdr.u32(poses.len() as u32);
    for (parent, child, pose) in poses {
        cdr.u32((time_ns / 1_000_000_000) as u32);
        cdr.u32((time_ns % 1_000_000_000) as u32);
        cdr.text(parent);
        cdr.text(child);
        pose.position_m.iter().chain(&pose.orientation_xyzw).for_each(|value| cdr.f64(*value));
    }
    [CDR_LITTLE_ENDIAN.as_slice(), &cdr.0].concat()
}

/// The body of a CDR message, little-endian: each number is aligned to its size, counted from the body's
/// start (OMG, DDS Interoperability Wire Protocol 2.5, clause 10; CORBA 3.4 part 2, clause 9.3).
struct Cdr(Vec<u8>);

impl Cdr {
    fn align(&mut self, to: usize) {
        self.0.resize(self.0.len().next_multiple_of(to), 0);
    }

    fn u32(&mut self, value: u32) {
        self.align(4);
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    fn f64(&mut self, value: f64) {
        self.align(8);
        self.0.extend_from_slice(&value.to_le_bytes());
    }

    /// Writes a string: its length with the NUL, the bytes, the NUL.
    fn text(&mut self, text: &str) {
        self.u32(text.len() as u32 + 1);
        self.0.extend_from_slice(text.as_bytes());
        self.0.push(0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_lie_at_multiples_of_their_size() {
        let pose = Pose { position_m: [1.0, 2.0, 3.0], ..Pose::IDENTITY };
        let bytes = tf_message(1_500_000_000, &[("world", "tip", &pose)]);
        let body = &bytes[4..];
        let u32_at = |at: usize| u32::from_le_bytes(body[at..at + 4].try_into().unwrap());
        let f64_at = |at: usize| f64::from_le_bytes(body[at..at + 8].try_into().unwrap());
        assert_eq!([u32_at(0), u32_at(4), u32_at(8), u32_at(12)], [1, 1, 500_000_000, 6]);
        // "world" and its NUL end at 22; the next length is at 24, "tip" and its NUL end at 32.
        assert_eq!(
            (&body[16..22], u32_at(24), &body[28..32]),
            (b"world\0".as_slice(), 4, b"tip\0".as_slice())
        );
        assert_eq!([f64_at(32), f64_at(40), f64_at(48), f64_at(80)], [1.0, 2.0, 3.0, 1.0]);
        assert_eq!(body.len(), 88);
    }
}
