//! Reads the frames of a log.

use std::path::PathBuf;

use messages::{Frame, ImagePrefix, Tick};
use zerocopy::FromBytes;

use crate::end::Ending;
use crate::error::LogError;
use crate::header::LogHeader;
use crate::source::LogSource;
use crate::stream::{MessageStream, ReadOptions};
use crate::topics::Topic;
use crate::verdict::Verdict;

/// One frame with its pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameRecord {
    /// The frame's metadata.
    pub frame: Frame,
    /// Size and time of the image; `None` if the log contains hashes only.
    pub image: Option<ImagePrefix>,
    /// `mono16` pixels, row by row, top left first, little-endian; empty without an image.
    pub pixels: Vec<u8>,
}

/// Iterates over the frames of a `run.mcap` in sequence. A missing frame is an error and ends the iteration,
/// unless the caller calls [`FrameReader::go_on`].
pub struct FrameReader {
    stream: MessageStream,
    /// Number of the next frame, if known.
    expected: Option<u64>,
    pending: Option<Frame>,
    /// A frame without an image, read just before a gap.
    before_gap: Option<Frame>,
    at_gap: bool,
    done: bool,
}

/// Opens a log to read its frames.
pub fn frames(log: &dyn LogSource, options: ReadOptions) -> Result<FrameReader, LogError> {
    Ok(FrameReader::from_stream(MessageStream::open(log, options)?))
}

impl FrameReader {
    /// Reads the frames of a stream.
    pub fn from_stream(stream: MessageStream) -> FrameReader {
        // The numbers of a log that begins later than its run begin anywhere.
        let expected = (stream.header().first_tick == Tick::START).then_some(1);
        FrameReader { stream, expected, pending: None, before_gap: None, at_gap: false, done: false }
    }

    /// The log's header.
    pub fn header(&self) -> &LogHeader {
        self.stream.header()
    }

    /// How the file ends. Known once the iteration has ended without an error.
    pub fn ending(&self) -> &Ending {
        self.stream.ending()
    }

    /// Returns the log's faults, as far as it has been read.
    pub fn verdict(&self) -> Verdict {
        self.stream.verdict()
    }

    /// Resumes after the missing frames once the iteration has ended with [`LogError::Gap`]. Returns false if
    /// it ended for another reason.
    pub fn go_on(&mut self) -> bool {
        let at_gap = std::mem::take(&mut self.at_gap);
        self.done &= !at_gap;
        at_gap
    }

    /// Reads the next frame. Its image follows immediately, or is not in the log.
    fn next_frame(&mut self) -> Result<Option<FrameRecord>, LogError> {
        let path: PathBuf = self.stream.path().into();
        if let Some(frame) = self.before_gap.take() {
            return Ok(Some(FrameRecord { frame, image: None, pixels: Vec::new() }));
        }
        while let Some(message) = self.stream.next_message()? {
            let without_image = |frame| FrameRecord { frame, image: None, pixels: Vec::new() };
            match message.known {
                Some(Topic::DrrFrame) => {
                    let Ok(frame) = Frame::read_from_bytes(message.body) else { continue };
                    let expected = self.expected.replace(frame.sequence.saturating_add(1));
                    let expected = expected.unwrap_or(frame.sequence);
                    if frame.sequence != expected {
                        let found = format!("frame {}, expected {expected}", frame.sequence);
                        self.before_gap = self.pending.replace(frame);
                        return Err(LogError::Gap {
                            path,
                            topic: Topic::DrrFrame,
                            tick: Tick(frame.tick),
                            found,
                        });
                    }
                    if let Some(previous) = self.pending.replace(frame) {
                        return Ok(Some(without_image(previous)));
                    }
                }
                Some(Topic::DrrImage) => {
                    let Ok((image, pixels)) = ImagePrefix::read_from_prefix(message.body) else { continue };
                    let Some(frame) = self.pending.take() else {
                        let tick = Tick(message.log_time_ns / self.stream.header().dt_ns.max(1));
                        let found = "an image without its frame".to_string();
                        return Err(LogError::Gap { path, topic: Topic::DrrFrame, tick, found });
                    };
                    return Ok(Some(FrameRecord { frame, image: Some(image), pixels: pixels.to_vec() }));
                }
                _ => {
                    if let Some(frame) = self.pending.take() {
                        return Ok(Some(without_image(frame)));
                    }
                }
            }
        }
        // The last frame of a truncated file may have lost its image.
        let whole = self.stream.ending().cut.is_none();
        let frame = self.pending.take().filter(|_| whole);
        Ok(frame.map(|frame| FrameRecord { frame, image: None, pixels: Vec::new() }))
    }
}

impl Iterator for FrameReader {
    type Item = Result<FrameRecord, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.done {
            return None;
        }
        let item = self.next_frame();
        self.done = !matches!(item, Ok(Some(_)));
        self.at_gap = matches!(item, Err(LogError::Gap { .. }));
        item.transpose()
    }
}
