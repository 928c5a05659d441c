//! Finds the header of a log. The file holds it twice, at the start and after the first chunk, each copy with
//! the scene, the calibration and its own checksums. The first readable copy is used.

use std::collections::BTreeMap;
use std::io::{Read, Seek};
use std::path::Path;

use crate::end::END_RECORD;
use crate::error::LogError;
use crate::header::{CALIBRATION_ATTACHMENT, HEADER_RECORD, LogHeader, RUNS_RECORD, SCENE_ATTACHMENT};
use crate::limits::MAX_SCENE_BYTES;
use crate::records::{AttachmentRecord, FileRecord, Records, Source};
use crate::walk::{WalkItem, walk};

/// Which copy of the header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum HeaderCopy {
    /// At the start of the file.
    First,
    /// After the first chunk.
    Second,
}

impl HeaderCopy {
    /// Name shown to users.
    pub fn name(self) -> &'static str {
        match self {
            HeaderCopy::First => "at the start",
            HeaderCopy::Second => "after the first chunk",
        }
    }
}

/// A header with its record's entries.
pub(crate) struct OpenedHeader {
    pub header: LogHeader,
    pub metadata: BTreeMap<String, String>,
    /// The records that follow the header.
    pub records: Records,
    /// Fault of the first copy; `None` if it was read.
    pub first_is_bad: Option<String>,
    /// Whether the copy that was read follows messages.
    pub is_behind: bool,
}

/// The parts of a header copy read so far.
#[derive(Default)]
pub(crate) struct Parts {
    scene: Option<String>,
    calibration: Option<String>,
}

impl Parts {
    /// Keeps an attachment that belongs to a header.
    pub fn take(&mut self, found: &AttachmentRecord) {
        let text = || {
            let kept = found.data.get(..MAX_SCENE_BYTES).unwrap_or(&found.data);
            Some(String::from_utf8_lossy(kept).into_owned())
        };
        match found.name.as_str() {
            SCENE_ATTACHMENT => self.scene = text(),
            CALIBRATION_ATTACHMENT => self.calibration = text(),
            _ => {}
        }
    }

    /// The complete header, called once its metadata record has been read.
    pub fn header(&mut self, path: &Path, entries: &BTreeMap<String, String>) -> Result<LogHeader, LogError> {
        let Parts { scene, calibration } = std::mem::take(self);
        LogHeader::from_metadata(path, entries, scene.unwrap_or_default(), calibration)
    }
}

/// Opens a log at its first header or, if that is unreadable, at its first chunk with the second header.
///
/// # Errors
/// Neither header can be read; describes what is wrong with the first.
pub(crate) fn open(source: Source, path: &Path) -> Result<OpenedHeader, LogError> {
    let mut records = Records::new(source, path)?;
    let mut parts = Parts::default();
    // Other programs that rewrite logs put metadata and attachments after the messages; that is not damage.
    let mut is_moved = false;
    let error = loop {
        match records.next_record() {
            Ok(FileRecord::Attachment(found)) => parts.take(&found),
            Ok(FileRecord::Metadata { name, entries }) if name == HEADER_RECORD => {
                match parts.header(path, &entries) {
                    Ok(header) => {
                        return Ok(OpenedHeader {
                            header,
                            metadata: entries,
                            records,
                            first_is_bad: None,
                            is_behind: false,
                        });
                    }
                    Err(error) => break error,
                }
            }
            Ok(FileRecord::Metadata { name, entries }) if name == RUNS_RECORD => {
                let runs = entries.get("count").cloned().unwrap_or_default();
                return Err(LogError::SeveralRuns { path: path.into(), runs });
            }
            Ok(FileRecord::Metadata { .. }) => (),
            Ok(found @ (FileRecord::Chunk | FileRecord::End | FileRecord::Cut(_))) => {
                is_moved = matches!(found, FileRecord::Chunk) && records.is_written_by_another();
                break LogError::NoHeader { path: path.into(), offset: records.offset() };
            }
            Err(error) => break error,
        }
    };
    let (mut source, bare) = records.into_source();
    match second(&mut source, path) {
        Found { header: Some((header, metadata)), first_chunk: Some(at) } => {
            let records = Records::at(source, path, at, bare)?;
            let first_is_bad = (!is_moved).then(|| cause(&error));
            Ok(OpenedHeader { header, metadata, records, first_is_bad, is_behind: true })
        }
        _ => Err(error),
    }
}

/// Describes what is wrong, without the file's name.
pub(crate) fn cause(error: &LogError) -> String {
    match error {
        LogError::Damaged { cause, .. } => cause.clone(),
        LogError::Metadata { key, expected, .. } => format!("its {key} is not {expected}"),
        LogError::NoHeader { .. } => "missing".to_string(),
        other => other.to_string(),
    }
}

/// Result of walking a log whose first header cannot be read.
#[derive(Default)]
struct Found {
    first_chunk: Option<u64>,
    header: Option<(LogHeader, BTreeMap<String, String>)>,
}

/// Searches for the second header, after the first chunk.
fn second<R: Read + Seek>(source: &mut R, path: &Path) -> Found {
    let (mut found, mut parts) = (Found::default(), Parts::default());
    let walked = walk(source, path, &mut |piece| {
        match piece {
            WalkItem::ChunkBegin(at) => _ = found.first_chunk.get_or_insert(at),
            WalkItem::Attachment(attached) if found.first_chunk.is_some() => parts.take(&attached),
            WalkItem::Metadata { name, entries } if name == HEADER_RECORD && found.first_chunk.is_some() => {
                found.header = parts.header(path, &entries).ok().map(|header| (header, entries));
            }
            WalkItem::Metadata { name, .. } if name == END_RECORD => return Err(enough(path)),
            _ => {}
        }
        if found.header.is_some() { Err(enough(path)) } else { Ok(()) }
    });
    // The walk was stopped on purpose; its error says nothing about the file.
    drop(walked);
    found
}

/// Returns an error that stops a walk.
fn enough(path: &Path) -> LogError {
    LogError::NoHeader { path: path.into(), offset: 0 }
}
