//! The frames of a log as pictures of its rows.

use std::path::PathBuf;

use figures::picture::grey_as_rgb8;
use recorder_proc::log_file::LogFile;
use run_log::{FrameReader, FrameRecord, LogError, LogSource, ReadOptions, Verdict, frames};

use super::super::dataset::refused;
use super::not_encoded;
use crate::dataset::lerobot::Picture;
use crate::failure::Failure;

/// The frames of a log, read as far as the rows need them.
pub(super) struct Pictures {
    reader: Option<FrameReader>,
    /// The frame after the current one.
    next: Option<FrameRecord>,
    current: Option<Picture>,
    path: PathBuf,
}

impl Pictures {
    /// Opens the log again, if its scene has an X-ray.
    pub(super) fn open(file: &LogFile, has_pictures: bool) -> Result<Pictures, Failure> {
        let reader = has_pictures.then(|| frames(file, ReadOptions::default())).transpose()?;
        let path = file.path().to_owned();
        let mut pictures = Pictures { reader, next: None, current: None, path };
        pictures.advance()?;
        Ok(pictures)
    }

    /// Whether the rows have pictures.
    pub(super) fn are_expected(&self) -> bool {
        self.reader.is_some()
    }

    /// Returns how the log ends, once all frames have been read.
    pub(super) fn verdict(&mut self) -> Result<Option<Verdict>, Failure> {
        while self.next.is_some() {
            self.advance()?;
        }
        Ok(self.reader.as_ref().map(FrameReader::verdict))
    }

    /// Returns the newest frame that shows this tick or one before it.
    pub(super) fn at(&mut self, tick: u64) -> Result<Option<Picture>, Failure> {
        let mut newest = None;
        while self.next.as_ref().is_some_and(|frame| frame.frame.tick <= tick) {
            newest = self.next.take();
            self.advance()?;
        }
        if let Some(record) = newest {
            let Some(image) = record.image else {
                let what = "the log has only the hashes of some frames; record it with \
                            `recording.images = \"full\"` and `recording.image_every = 1`";
                return Err(refused(&self.path, what));
            };
            let greys = record.pixels.chunks_exact(2).map(|pixel| u16::from_le_bytes([pixel[0], pixel[1]]));
            let (png, pixels) = grey_as_rgb8(image.width, image.height, greys).map_err(not_encoded)?;
            self.current = Some(Picture { png, pixels });
        }
        Ok(self.current.clone())
    }

    fn advance(&mut self) -> Result<(), Failure> {
        let Some(reader) = &mut self.reader else { return Ok(()) };
        self.next = loop {
            match reader.next() {
                None => break None,
                Some(Ok(record)) => break Some(record),
                Some(Err(LogError::Gap { .. })) if reader.go_on() => {}
                Some(Err(error)) => return Err(error.into()),
            }
        };
        Ok(())
    }
}
