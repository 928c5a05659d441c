//! Determines the expected contents of a frame from its reply, its request and the scene.

use std::collections::VecDeque;
use std::path::PathBuf;

use ipc_types::messages::layout::Message;
use ipc_types::messages::{CArmGeometry, DrrReply, DrrRequest, DrrStatus, Frame, GeometryChoice, Tick};
use ipc_types::scene::Drr;
use recorder_proc::log_file::LogFile;
use run_log::difference::compare;
use run_log::{MessageStream, ReadOptions, Topic};
use xray::from_scene::scene_c_arm;
use xray::message::c_arm_message;
use xxhash_rust::xxh3::xxh3_64;
use zerocopy::{FromBytes, IntoBytes};

use super::OpenedLog;
use crate::failure::Failure;

/// Maximum number of replies before their frames: more than the renderer has in flight.
const MAX_WAITING: usize = 4096;

/// The accepted replies of a log, in frame order.
pub struct Replies {
    stream: MessageStream,
    waiting: VecDeque<DrrReply>,
    /// The scene's C-arm.
    scene: CArmGeometry,
    requests: Requests,
    /// On-demand frames whose request is not in the timing lane.
    without_request: u64,
    path: PathBuf,
    options: ReadOptions,
    /// Whether the log lacks replies; `None` until first needed.
    lacks: Option<bool>,
}

impl Replies {
    /// Opens the replies of a log, with the requests of its timing lane.
    pub fn open(log: &OpenedLog, drr: &Drr) -> Result<Replies, Failure> {
        let scene = scene_c_arm(drr).map_err(Failure::failed)?;
        let scene = c_arm_message(&scene);
        let wanted = [Topic::DrrReply.name().to_owned()];
        let stream = MessageStream::open_topics(&LogFile::at(&log.path), &wanted, log.options())?;
        let (path, options) = (log.path.clone(), log.options());
        let requests = Requests::of(path.with_file_name("timing.mcap"), options, scene);
        let waiting = VecDeque::new();
        Ok(Replies { stream, waiting, scene, requests, without_request: 0, path, options, lacks: None })
    }

    /// Returns the number of on-demand frames so far whose request is not in the timing lane, so that their
    /// C-arm is compared only with the reply's.
    pub fn without_request(&self) -> u64 {
        self.without_request
    }

    /// Returns the expected C-arm of a frame: the scene's or the requested one.
    pub fn geometry_of(&mut self, frame: &Frame) -> Result<CArmGeometry, String> {
        let Some(reply) = self.reply_of(frame.sequence)? else {
            // A log that lacks replies is marked as such. A scheduled frame always shows the scene's C-arm.
            return match (self.lacks_some(), frame.request_id) {
                (false, _) => Err(format!("{} has no reply for it", Topic::DrrReply.name())),
                (true, 0) => Ok(self.scene),
                (true, _) => Ok(frame.geometry),
            };
        };
        let expected = DrrReply {
            request_id: frame.request_id,
            frame_sequence: frame.sequence,
            tick: frame.tick,
            status: DrrStatus::Accepted.code(),
            requester: if frame.request_id == 0 { 0 } else { reply.requester },
            geometry: self.asked_for(frame.request_id, &reply),
        };
        let (a, b) = (reply.as_bytes(), expected.as_bytes());
        match compare(Topic::DrrReply, Tick(frame.tick), DrrReply::DESCRIPTION, a, b) {
            Some(difference) => Err(difference.to_string()),
            None => Ok(expected.geometry),
        }
    }

    /// Returns the requested C-arm, or the one in the reply if the request is unknown.
    fn asked_for(&mut self, request_id: u64, reply: &DrrReply) -> CArmGeometry {
        if request_id == 0 {
            return self.scene;
        }
        self.requests.asked_for((reply.requester, request_id), &reply.geometry).unwrap_or_else(|| {
            self.without_request += 1;
            reply.geometry
        })
    }

    fn reply_of(&mut self, sequence: u64) -> Result<Option<DrrReply>, String> {
        while self.waiting.len() < MAX_WAITING
            && self.waiting.back().is_none_or(|r| r.frame_sequence < sequence)
        {
            let Some(message) = self.stream.next_message().map_err(|cause| cause.to_string())? else { break };
            let Ok(reply) = DrrReply::read_from_bytes(message.body) else { continue };
            if reply.status() == Ok(DrrStatus::Accepted) {
                self.waiting.push_back(reply);
            }
        }
        while self.waiting.front().is_some_and(|reply| reply.frame_sequence < sequence) {
            self.waiting.pop_front();
        }
        let is_it = self.waiting.front().is_some_and(|reply| reply.frame_sequence == sequence);
        Ok(if is_it { self.waiting.pop_front() } else { None })
    }

    /// Returns whether the log lacks replies, according to its end marker.
    fn lacks_some(&mut self) -> bool {
        let (path, options) = (&self.path, self.options);
        *self.lacks.get_or_insert_with(|| {
            let wanted = [Topic::DrrReply.name().to_owned()];
            let Ok(mut stream) = MessageStream::open_topics(&LogFile::at(path), &wanted, options) else {
                return true;
            };
            while let Ok(Some(_)) = stream.next_message() {}
            !stream.verdict().is_intact()
        })
    }
}

/// Requester and request number; a controller can reuse a number.
type Key = (u32, u64);

/// The requests of the timing lane. Only the key and a hash of the C-arm are kept of each (24 bytes), so that
/// a day's requests fit in memory; the C-arm itself is reread to report a difference.
struct Requests {
    timing: PathBuf,
    options: ReadOptions,
    scene: CArmGeometry,
    /// In order.
    known: Vec<(Key, u64)>,
}

impl Requests {
    /// Reads the requests as far as possible; empty if the timing lane is missing.
    fn of(timing: PathBuf, options: ReadOptions, scene: CArmGeometry) -> Requests {
        let mut requests = Requests { timing, options, scene, known: Vec::new() };
        let mut known = Vec::new();
        requests.find(|key, geometry| {
            known.push((key, hash(geometry)));
            false
        });
        known.sort_unstable();
        requests.known = known;
        requests
    }

    /// Returns the first matching request.
    fn find(&self, mut wanted: impl FnMut(Key, &CArmGeometry) -> bool) -> Option<CArmGeometry> {
        let topics = [Topic::DrrRequest.name().to_owned()];
        let mut stream =
            MessageStream::open_topics(&LogFile::at(&self.timing), &topics, self.options).ok()?;
        while let Ok(Some(message)) = stream.next_message() {
            let Ok(request) = DrrRequest::read_from_bytes(message.body) else { continue };
            let chosen = request.use_geometry() == Ok(GeometryChoice::Request);
            let geometry = if chosen { request.geometry } else { self.scene };
            if wanted((request.requester, request.request_id), &geometry) {
                return Some(geometry);
            }
        }
        None
    }

    /// Returns `replied` if a request with this key asked for it, otherwise the C-arm of the first one;
    /// `None` without a request.
    fn asked_for(&self, key: Key, replied: &CArmGeometry) -> Option<CArmGeometry> {
        if self.known.binary_search(&(key, hash(replied))).is_ok() {
            return Some(*replied);
        }
        let first = self.known.partition_point(|known| known.0 < key);
        self.known.get(first).filter(|known| known.0 == key)?;
        self.find(|asked, _| asked == key)
    }
}

fn hash(geometry: &CArmGeometry) -> u64 {
    xxh3_64(geometry.as_bytes())
}
