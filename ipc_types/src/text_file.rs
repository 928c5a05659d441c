//! Reads whole files that a user names: texts (scenes, poses, calibrations) and meshes. A device, a pipe or
//! an endless file is rejected by name; reading it would block or fill the memory.

use std::fs::OpenOptions;
use std::io::{self, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

/// Size limit, bytes. Our largest text file, a batch of poses, is a hundredth of it.
pub const MAX_TEXT_BYTES: u64 = 16 << 20;

const BYTE_ORDER_MARK: char = '\u{feff}';

/// Reads a regular file of at most [`MAX_TEXT_BYTES`] as UTF-8, without the byte order mark that some
/// spreadsheets and editors write.
///
/// # Errors
/// System errors; also if it is not a regular file, too long, or not UTF-8.
pub fn read(path: &Path) -> io::Result<String> {
    let not_text = |_| io::Error::new(io::ErrorKind::InvalidData, "stream did not contain valid UTF-8");
    let mut text = String::from_utf8(read_bytes(path, MAX_TEXT_BYTES)?).map_err(not_text)?;
    if text.starts_with(BYTE_ORDER_MARK) {
        text.drain(..BYTE_ORDER_MARK.len_utf8());
    }
    Ok(text)
}

/// Reads a regular file of at most `most` bytes.
///
/// # Errors
/// System errors; also if it is not a regular file or too long.
pub fn read_bytes(path: &Path, most: u64) -> io::Result<Vec<u8>> {
    // Non-blocking, so that opening a pipe returns and the type check can reject it.
    let file = OpenOptions::new().read(true).custom_flags(libc::O_NONBLOCK).open(path)?;
    if !file.metadata()?.is_file() {
        return Err(io::Error::other("not a regular file"));
    }
    let mut bytes = Vec::new();
    file.take(most + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most {
        return Err(io::Error::other(format!("longer than {most} bytes")));
    }
    Ok(bytes)
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;

    #[test]
    fn only_a_regular_file_of_a_sane_length_is_read() {
        let folder = std::env::temp_dir().join(format!("trabecula-text-{}", std::process::id()));
        std::fs::create_dir(&folder).unwrap();
        let [text, pipe, long] = ["text", "pipe", "long"].map(|name| folder.join(name));
        std::fs::write(&text, "a = 1\n").unwrap();
        rustix::fs::mkfifoat(rustix::fs::CWD, &pipe, rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR)
            .unwrap();
        std::fs::File::create(&long).unwrap().set_len(MAX_TEXT_BYTES + 1).unwrap();
        let refused = |path: &Path| read(path).unwrap_err().to_string();
        assert_eq!(read(&text).unwrap(), "a = 1\n");
        std::fs::write(&text, "\u{feff}a = 1\n").unwrap();
        assert_eq!(read(&text).unwrap(), "a = 1\n");
        for path in [&pipe, Path::new("/dev/zero"), Path::new("/dev/null"), &folder] {
            assert!(refused(path).contains("not a regular file"), "{}", path.display());
        }
        assert!(refused(&long).contains("longer than 16777216 bytes"));
        std::fs::remove_dir_all(&folder).unwrap();
    }
}
