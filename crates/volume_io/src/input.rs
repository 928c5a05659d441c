//! Opens files and compressed streams without trusting the sizes they claim.

use crate::error::{Field, VolumeError};
use crate::gzip::GzipMembers;
use foreign_text::counted;
use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// A stream encoding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Codec {
    Raw,
    Gzip,
    Zlib,
    Bzip2,
    /// Two hexadecimal digits per byte, white space anywhere.
    Hex,
}

impl Codec {
    pub fn name(self) -> &'static str {
        match self {
            Codec::Raw => "raw",
            Codec::Gzip => "gzip",
            Codec::Zlib => "zlib",
            Codec::Bzip2 => "bzip2",
            Codec::Hex => "hex",
        }
    }

    /// Upper bound of the decoded size of `compressed` bytes. Deflate cannot exceed 1032:1 (zlib technical
    /// notes). bzip2 has no useful bound (45 MB from 45 bytes), so this limit is our own: a hundred times
    /// what a mask reaches, and enough for any small volume.
    fn most_bytes(self, compressed: u64) -> u64 {
        match self {
            Codec::Raw => compressed,
            Codec::Hex => compressed / 2,
            Codec::Gzip | Codec::Zlib => compressed.saturating_mul(1032),
            Codec::Bzip2 => compressed.saturating_mul(BZIP2_RATIO).saturating_add(BZIP2_FREE_BYTES),
        }
    }
}

/// Largest decoded size per byte of bzip2 data, beyond [`BZIP2_FREE_BYTES`].
const BZIP2_RATIO: u64 = 10_000;
const BZIP2_FREE_BYTES: u64 = 16 << 20;

/// Where the files that a header names, or that a folder links to, may be.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DataFiles {
    /// In the header's folder, after following all links.
    #[default]
    Beside,
    /// Anywhere: the author of the header is trusted.
    Anywhere,
}

/// An I/O error with the file and what was attempted.
pub(crate) fn io_error(path: &Path, action: &'static str) -> impl FnOnce(std::io::Error) -> VolumeError {
    move |source| VolumeError::Io { path: path.into(), action, source }
}

/// Opens a regular file; returns it with its length.
pub(crate) fn open(path: &Path) -> Result<(File, u64), VolumeError> {
    // Checks the type before opening, because opening a pipe would block until it has a writer.
    let metadata = std::fs::metadata(path).map_err(io_error(path, "open"))?;
    if !metadata.is_file() {
        return Err(VolumeError::not_a_volume(path, "not a regular file"));
    }
    let file = File::open(path).map_err(io_error(path, "open"))?;
    Ok((file, metadata.len()))
}

/// The decoded content of a file.
pub(crate) trait Stream: Read {
    /// At the end: whether the file holds further bytes, which are ignored.
    ///
    /// # Errors
    /// Any error of the file.
    fn has_more(&mut self) -> std::io::Result<bool> {
        Ok(false)
    }
}

impl Stream for BufReader<File> {}
impl Stream for flate2::bufread::ZlibDecoder<BufReader<File>> {}
impl Stream for bzip2::bufread::MultiBzDecoder<BufReader<File>> {}
impl Stream for HexDigits<BufReader<File>> {}

/// The decoded content of a file from byte `offset`, and its largest possible size.
pub(crate) fn open_stream(
    path: &Path,
    offset: u64,
    codec: Codec,
) -> Result<(Box<dyn Stream>, u64), VolumeError> {
    let (mut file, length) = open(path)?;
    if offset > length {
        return Err(VolumeError::truncated(path, "file", [length, offset]));
    }
    file.seek(SeekFrom::Start(offset)).map_err(io_error(path, "seek"))?;
    let reader = BufReader::with_capacity(1 << 16, file);
    let stream: Box<dyn Stream> = match codec {
        Codec::Raw => Box::new(reader),
        Codec::Gzip => Box::new(GzipMembers::new(reader)),
        Codec::Zlib => Box::new(flate2::bufread::ZlibDecoder::new(reader)),
        Codec::Bzip2 => Box::new(bzip2::bufread::MultiBzDecoder::new(reader)),
        Codec::Hex => Box::new(HexDigits(reader)),
    };
    Ok((stream, codec.most_bytes(length - offset)))
}

/// Decodes pairs of hexadecimal digits.
struct HexDigits<R>(R);

impl<R: BufRead> HexDigits<R> {
    /// Returns the next digit's value, or `None` at the end.
    fn digit(&mut self) -> std::io::Result<Option<u8>> {
        loop {
            let Some(&byte) = self.0.fill_buf()?.first() else { return Ok(None) };
            self.0.consume(1);
            if byte.is_ascii_whitespace() {
                continue;
            }
            let digit = char::from(byte).to_digit(16);
            let wrong = || {
                std::io::Error::new(
                    ErrorKind::InvalidData,
                    format!("{:?} is not a hexadecimal digit", char::from(byte)),
                )
            };
            return digit.map(|digit| Some(digit as u8)).ok_or_else(wrong);
        }
    }
}

impl<R: BufRead> Read for HexDigits<R> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        for (filled, slot) in buffer.iter_mut().enumerate() {
            let (Some(high), Some(low)) = (self.digit()?, self.digit()?) else { return Ok(filled) };
            *slot = 16 * high + low;
        }
        Ok(buffer.len())
    }
}

/// Fails before any allocation if a stream of at most `most_bytes` cannot hold `needed_bytes`; for bzip2 by
/// our own limit.
pub(crate) fn check_length(path: &Path, most_bytes: u64, needed_bytes: u64) -> Result<(), VolumeError> {
    if most_bytes >= needed_bytes {
        return Ok(());
    }
    Err(VolumeError::truncated(path, "voxel data", [most_bytes, needed_bytes]))
}

/// Fills `buffer` until the stream ends; returns the number of bytes read. A truncated stream counts as ended
/// there.
pub(crate) fn read_full(
    path: &Path,
    codec: &'static str,
    reader: &mut dyn Read,
    buffer: &mut [u8],
) -> Result<usize, VolumeError> {
    let mut filled = 0;
    while filled < buffer.len() {
        match reader.read(&mut buffer[filled..]) {
            Ok(0) => break,
            Ok(n) => filled += n,
            Err(e) if e.kind() == ErrorKind::Interrupted => {}
            Err(e) if e.kind() == ErrorKind::UnexpectedEof => break,
            Err(e) if codec == Codec::Raw.name() => return Err(io_error(path, "read")(e)),
            Err(e) => return Err(VolumeError::Corrupt { path: path.into(), codec, reason: e.to_string() }),
        }
    }
    Ok(filled)
}

/// Reads and discards `count` bytes.
pub(crate) fn skip(
    path: &Path,
    codec: &'static str,
    reader: &mut dyn Read,
    count: u64,
) -> Result<(), VolumeError> {
    let mut buffer = [0_u8; 8192];
    let mut left = count;
    while left > 0 {
        let wanted = left.min(buffer.len() as u64) as usize;
        let got = read_full(path, codec, reader, &mut buffer[..wanted])?;
        if got == 0 {
            return Err(VolumeError::truncated(path, "bytes before the voxel data", [count - left, count]));
        }
        left -= got as u64;
    }
    Ok(())
}

/// Checks what follows the voxels of a stream, which end at byte `needed` according to the header's `field`;
/// the stream holds at most `most` bytes.
///
/// Extra compressed bytes mean that the header is wrong, and with it every voxel. After raw voxels some
/// programs write padding and trailers; ITK and nibabel ignore them, and so does this reader, with a note.
pub(crate) fn check_end(
    path: &Path,
    codec: Codec,
    reader: &mut dyn Stream,
    (field, needed, most): (&str, u64, u64),
    notes: &mut Vec<String>,
) -> Result<(), VolumeError> {
    if codec == Codec::Raw {
        if most > needed {
            notes.push(format!("ignored {} after the voxel data", counted(most - needed, "byte")));
        }
        return Ok(());
    }
    let mut one = [0_u8];
    if read_full(path, codec.name(), reader, &mut one)? == 0 {
        if reader.has_more().map_err(io_error(path, "read"))? {
            notes.push(format!("bytes after the {} data are ignored", codec.name()));
        }
        return Ok(());
    }
    Err(VolumeError::header(
        path,
        field,
        format!("more than {needed} bytes of data"),
        "exactly the bytes of the voxels",
    ))
}

/// The first bytes of a stream, at most `count`.
pub(crate) fn head(path: &Path, offset: u64, codec: Codec, count: usize) -> Result<Vec<u8>, VolumeError> {
    let (mut reader, _) = open_stream(path, offset, codec)?;
    let mut bytes = vec![0; count];
    let got = read_full(path, codec.name(), reader.as_mut(), &mut bytes)?;
    bytes.truncate(got);
    Ok(bytes)
}

/// Resolves the data file that a header names in `field`; relative names are relative to the header's folder.
///
/// The returned path contains no link, so that the opened file is the checked one.
pub(crate) fn data_file(
    header: &Path,
    field: &str,
    name: &str,
    files: DataFiles,
) -> Result<PathBuf, VolumeError> {
    let folder = folder_of(header);
    let path = folder.join(name);
    let real = inside(folder, &path, files)?;
    real.ok_or_else(|| VolumeError::Elsewhere(Field::new(header, field, format!("`{name}`"))))
}

/// The folder that contains a path.
pub(crate) fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    }
}

/// Resolves all links of a path; `None` if the target must be in `folder` and is not.
pub(crate) fn inside(folder: &Path, path: &Path, files: DataFiles) -> Result<Option<PathBuf>, VolumeError> {
    if files == DataFiles::Anywhere {
        return Ok(Some(path.to_owned()));
    }
    let real_folder = folder.canonicalize().map_err(io_error(folder, "open"))?;
    let real = path.canonicalize().map_err(io_error(path, "open"))?;
    Ok(real.starts_with(&real_folder).then_some(real))
}

/// Lower-case file name, for extensions of two parts.
pub(crate) fn lower_name(path: &Path) -> String {
    path.file_name().map(|n| n.to_string_lossy().to_lowercase()).unwrap_or_default()
}
