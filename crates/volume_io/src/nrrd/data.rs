//! Reads the numbers of an NRRD file: attached, in one data file or in several.

use super::header::Header;
use crate::data_files::{DataFile, named, read_each};
use crate::error::{Field, VolumeError};
use crate::input::{self, Codec};
use crate::scalar::{HuSink, Layout, Scale};
use crate::text_header::{read_ascii, wrong};
use std::path::Path;

/// Description of the stored form, for display.
pub(super) struct StoredForm {
    pub encoding: String,
    pub voxels: String,
}

impl Header<'_> {
    /// Reads `count` numbers from the data files.
    pub(super) fn read_data(
        &self,
        count: usize,
        sink: &mut HuSink,
        notes: &mut Vec<String>,
    ) -> Result<StoredForm, VolumeError> {
        let scalar = self.scalar()?;
        let encoding = self.require("encoding", "raw, gzip, bzip2, hex or ascii")?.to_lowercase();
        let codec = match encoding.as_str() {
            "ascii" | "text" | "txt" => None,
            "raw" => Some(Codec::Raw),
            "gzip" | "gz" => Some(Codec::Gzip),
            "bzip2" | "bz2" => Some(Codec::Bzip2),
            "hex" => Some(Codec::Hex),
            other => return Err(self.unsupported("encoding", other, "raw, gzip, bzip2, hex or ascii")),
        };
        let files = self.data_files()?;
        let Some(codec) = codec else {
            read_each(self.path, "data file", &files, count, |file, part| {
                read_ascii(&file.path, self.behind_lines(file)?, part, sink)
            })?;
            return Ok(StoredForm { encoding, voxels: scalar.name().into() });
        };
        let layout = Layout { scalar, endian: self.endian(scalar)?, scale: Scale::IDENTITY };
        read_each(self.path, "data file", &files, count, |file, part| {
            self.read_binary(file, layout, codec, part, sink, notes)
        })?;
        Ok(StoredForm { encoding, voxels: layout.scalar.describe(layout.endian) })
    }

    /// The data files in order; the header's own file for attached data.
    fn data_files(&self) -> Result<Vec<DataFile>, VolumeError> {
        let field = "data file";
        let Some(value) = self.get(field) else {
            return Ok(vec![DataFile { path: self.path.to_path_buf(), start: self.length }]);
        };
        named(self.path, (field, value), &self.list, self.files)
    }

    /// The byte after the lines skipped by `line skip`.
    fn behind_lines(&self, file: &DataFile) -> Result<u64, VolumeError> {
        let (path, start) = (&file.path, file.start);
        let mut left = self.whole("line skip", 0)?;
        let mut offset = start;
        if left == 0 {
            return Ok(offset);
        }
        let (mut reader, _) = input::open_stream(path, start, Codec::Raw)?;
        let mut buffer = vec![0_u8; 1 << 16];
        while left > 0 {
            let got = input::read_full(path, Codec::Raw.name(), reader.as_mut(), &mut buffer)?;
            if got == 0 {
                let given = self.get("line skip").unwrap_or("");
                return Err(wrong(
                    self.path,
                    "line skip",
                    given,
                    "at most as many lines as the data file has",
                ));
            }
            for &byte in &buffer[..got] {
                if left == 0 {
                    break;
                }
                offset += 1;
                left -= i64::from(byte == b'\n');
            }
        }
        Ok(offset)
    }

    fn read_binary(
        &self,
        file: &DataFile,
        layout: Layout,
        codec: Codec,
        count: usize,
        sink: &mut HuSink,
        notes: &mut Vec<String>,
    ) -> Result<(), VolumeError> {
        let (path, start) = (file.path.as_path(), self.behind_lines(file)?);
        // −1: the voxels are the last bytes of the (decoded) data.
        let byte_skip = self.whole("byte skip", -1)?;
        let skip = match u64::try_from(byte_skip) {
            Ok(skip) => skip,
            Err(_) => {
                let (length, needed) = (decoded_length(path, start, codec)?, layout.byte_count(count));
                input::check_length(path, length, needed)?;
                length - needed
            }
        };
        layout.read_file((path, start, codec), skip, ("sizes, byte skip", count), sink, notes)
    }
}

/// Length of a decoded stream; decodes it without keeping the data.
fn decoded_length(path: &Path, start: u64, codec: Codec) -> Result<u64, VolumeError> {
    let (mut reader, most_bytes) = input::open_stream(path, start, codec)?;
    if codec == Codec::Raw {
        return Ok(most_bytes);
    }
    // Twice the largest volume of the widest type: anything longer is a decompression bomb.
    let most_bytes = most_bytes.min(16 * voxel_grid::MAX_VOXELS as u64);
    let mut buffer = vec![0_u8; 1 << 16];
    let mut length = 0;
    loop {
        match input::read_full(path, codec.name(), reader.as_mut(), &mut buffer)? {
            0 => return Ok(length),
            got => length += got as u64,
        }
        if length > most_bytes {
            return Err(VolumeError::TooLarge(Field::new(
                path,
                "voxel data",
                format!("more than {length} decoded bytes"),
            )));
        }
    }
}
