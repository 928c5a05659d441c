//! Where events come from: a device node or a pipe, as they happen; or a recording, in simulated time.

use std::fs::{File, Metadata, OpenOptions};
use std::io::{ErrorKind, Read};
use std::os::unix::fs::{FileTypeExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::Instant;

use ipc_types::text_file;
use rustix::fs::OFlags;

use super::event::{EventReader, InputEvent, RECORD_BYTES};
use super::{DeviceError, DeviceKind, DeviceSource, list};

/// Bytes of a recording: 2.8 million events.
const MAX_RECORDING_BYTES: u64 = 64 << 20;
/// Events read at once, and number of such reads between two commands: a flood delays no command.
const EVENTS_AT_ONCE: usize = 64;
const READS_AT_ONCE: usize = 16;

/// A source of events.
#[derive(Debug)]
pub(crate) enum Source {
    Live(LiveSource),
    Recorded(Recording),
}

/// Whether a source still has something to say.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Sign {
    /// The device is there.
    Alive,
    /// A recording has played its last event.
    Silent,
    /// The device has vanished, and why.
    Gone(String),
}

#[derive(Debug)]
pub(crate) struct LiveSource {
    path: PathBuf,
    file: File,
    reader: EventReader,
    /// A pipe without a writer is empty, as is one whose writer has left.
    has_begun: bool,
    opened: Instant,
}

/// Events with times relative to the first one, in the order of the file.
#[derive(Debug)]
pub(crate) struct Recording {
    events: Vec<InputEvent>,
    next: usize,
    /// Simulated time of the first state, at which the first event takes effect.
    begun_s: Option<f64>,
}

impl Source {
    pub(crate) fn open(source: &DeviceSource, kind: DeviceKind) -> Result<Source, DeviceError> {
        match source {
            DeviceSource::Found => LiveSource::open(&only_device(kind)?).map(Source::Live),
            DeviceSource::Device(path) => LiveSource::open(path).map(Source::Live),
            DeviceSource::Recording(path) => Recording::open(path).map(Source::Recorded),
        }
    }

    /// Returns what is read, for a message.
    pub(crate) fn name(&self) -> String {
        match self {
            Source::Live(live) => foreign_text::foreign_path(&live.path),
            Source::Recorded(recording) => foreign_text::counted(recording.events.len(), "recorded event"),
        }
    }

    /// Whether events have the time at which they happened.
    pub(crate) fn is_live(&self) -> bool {
        matches!(self, Source::Live(_))
    }

    /// Returns the time on the source's clock; `sim_time_s` is that of the newest state.
    pub(crate) fn now_s(&self, sim_time_s: f64) -> f64 {
        match self {
            Source::Live(live) => live.opened.elapsed().as_secs_f64(),
            Source::Recorded(_) => sim_time_s,
        }
    }

    /// Passes on the events up to a time on the source's clock. Never waits.
    pub(crate) fn drain(&mut self, now_s: f64, event: impl FnMut(InputEvent)) -> Sign {
        match self {
            Source::Live(live) => live.drain(event),
            Source::Recorded(recording) => recording.drain(now_s, event),
        }
    }
}

fn only_device(kind: DeviceKind) -> Result<PathBuf, DeviceError> {
    let mut nodes: Vec<PathBuf> =
        list::devices().into_iter().filter(|device| device.kind == kind).map(|device| device.node).collect();
    match (nodes.pop(), nodes.len()) {
        (Some(only), 0) => Ok(only),
        (None, _) => Err(DeviceError::NotFound { kind }),
        (Some(last), _) => {
            nodes.push(last);
            Err(DeviceError::Several { kind, nodes })
        }
    }
}

impl LiveSource {
    fn open(path: &Path) -> Result<LiveSource, DeviceError> {
        // Non-blocking, so that opening a pipe does not wait for its writer.
        let flags = OFlags::NONBLOCK.bits() as i32;
        let file = OpenOptions::new().read(true).custom_flags(flags).open(path);
        let file = file.and_then(|file| file.metadata().map(|metadata| (file, metadata)));
        let (file, metadata) = file.map_err(|cause| DeviceError::open(path, cause))?;
        if !is_event_device(&metadata) && !metadata.file_type().is_fifo() {
            return Err(DeviceError::NotADevice { path: path.to_owned() });
        }
        Ok(LiveSource {
            path: path.to_owned(),
            file,
            reader: EventReader::default(),
            has_begun: false,
            opened: Instant::now(),
        })
    }

    fn drain(&mut self, mut event: impl FnMut(InputEvent)) -> Sign {
        let mut bytes = [0; EVENTS_AT_ONCE * RECORD_BYTES];
        for _ in 0..READS_AT_ONCE {
            match self.file.read(&mut bytes) {
                Ok(0) if self.has_begun => {
                    let cut = match self.reader.held_bytes() {
                        0 => String::new(),
                        bytes => format!("; its last record is truncated: {bytes} of {RECORD_BYTES} bytes"),
                    };
                    return Sign::Gone(format!("closed by its writer{cut}"));
                }
                Ok(0) => return Sign::Alive,
                Ok(count) => {
                    self.has_begun = true;
                    self.reader.feed(&bytes[..count], &mut event);
                }
                Err(cause) if cause.kind() == ErrorKind::WouldBlock => return Sign::Alive,
                Err(cause) if cause.kind() == ErrorKind::Interrupted => {}
                Err(cause) => return Sign::Gone(cause.to_string()),
            }
        }
        Sign::Alive
    }
}

/// Returns whether a file is an event device: Linux numbers input devices 13, of which joysticks and mice
/// have the first 64 minor numbers (Documentation/admin-guide/devices.txt).
fn is_event_device(metadata: &Metadata) -> bool {
    let device = metadata.rdev();
    let is_event = rustix::fs::major(device) == 13 && rustix::fs::minor(device) >= 64;
    metadata.file_type().is_char_device() && is_event
}

impl Recording {
    fn open(path: &Path) -> Result<Recording, DeviceError> {
        let bytes = text_file::read_bytes(path, MAX_RECORDING_BYTES);
        Recording::of(&bytes.map_err(|cause| DeviceError::open(path, cause))?)
            .ok_or_else(|| DeviceError::NotARecording { path: path.to_owned() })
    }

    /// Reads a recording; `None` if it has no event or ends within one.
    fn of(bytes: &[u8]) -> Option<Recording> {
        let (mut reader, mut events) = (EventReader::default(), Vec::new());
        reader.feed(bytes, |event| events.push(event));
        let first_s = events.first()?.time_s;
        events.iter_mut().for_each(|event| event.time_s -= first_s);
        (reader.held_bytes() == 0).then_some(Recording { events, next: 0, begun_s: None })
    }

    fn drain(&mut self, now_s: f64, mut event: impl FnMut(InputEvent)) -> Sign {
        let is_over = self.next == self.events.len();
        // Simulated times are multiples of a tick; those of events, of a microsecond.
        let passed_s = now_s - *self.begun_s.get_or_insert(now_s) + 1e-7;
        while let Some(next) = self.events.get(self.next).filter(|next| next.time_s <= passed_s) {
            event(*next);
            self.next += 1;
        }
        if is_over { Sign::Silent } else { Sign::Alive }
    }
}

#[cfg(test)]
mod tests {
    use super::super::event::{EV_ABS, record};
    use super::*;

    #[test]
    fn a_recording_plays_in_simulated_time_from_the_first_state_on() {
        let times_us = [7_000_000, 7_002_000, 7_001_000, 7_010_000];
        let bytes: Vec<u8> =
            times_us.iter().zip(0..).flat_map(|(time, code)| record(*time, EV_ABS, code, 5)).collect();
        let mut recording = Recording::of(&bytes).unwrap();
        let mut at = |now_s: f64| {
            let mut codes = Vec::new();
            let sign = recording.drain(now_s, |event| codes.push(event.code));
            (codes, sign)
        };
        assert_eq!(at(3.0), (vec![0], Sign::Alive));
        assert_eq!(at(3.001), (vec![], Sign::Alive));
        assert_eq!(at(3.002), (vec![1, 2], Sign::Alive), "one that goes back in time is not skipped");
        assert_eq!(at(3.01), (vec![3], Sign::Alive));
        assert_eq!(at(3.011), (vec![], Sign::Silent), "from here on rates run out");
        assert!(Recording::of(&bytes[..bytes.len() - 1]).is_none(), "truncated");
        assert!(Recording::of(&[]).is_none());
    }

    /// Regression for what a hostile pipe can do: nothing, whatever its bytes are and wherever they end.
    #[test]
    fn a_pipe_is_read_to_its_writers_end_without_waiting() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pipe");
        let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
        rustix::fs::mkfifoat(rustix::fs::CWD, &path, mode).unwrap();
        let mut live = LiveSource::open(&path).unwrap();
        assert_eq!(live.drain(|_| {}), Sign::Alive, "no writer yet");
        let mut writer = OpenOptions::new().write(true).open(&path).unwrap();
        assert_eq!(live.drain(|_| {}), Sign::Alive, "no event yet");
        let mut count = 0;
        std::io::Write::write_all(&mut writer, &[record(1, EV_ABS, 0, 1), vec![0xff; 30]].concat()).unwrap();
        assert_eq!(live.drain(|_| count += 1), Sign::Alive);
        drop(writer);
        let Sign::Gone(why) = live.drain(|_| count += 1) else { panic!("the writer has left") };
        assert_eq!(
            (count, why.as_str()),
            (2, "closed by its writer; its last record is truncated: 6 of 24 bytes")
        );
        for other in [folder.path(), Path::new("/dev/zero")] {
            let error = LiveSource::open(other).unwrap_err().to_string();
            assert!(error.contains("neither an event device"), "{error}");
        }
    }
}
