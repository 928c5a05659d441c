//! Cached texts: tables of measured errors.
//!
//! ```text
//! trabecula text 1 KEY CHECKSUM      64 and 32 hexadecimal digits, and a line feed
//! the text
//! ```
//!
//! The checksum is XXH3-128 of the key and the text.

use std::io::{self, Read, Write};
use std::path::PathBuf;

use data_encoding::HEXLOWER;
use sha2::Digest;
use xxhash_rust::xxh3::xxh3_128;

use super::Cache;
use super::entry::Damage;
use super::key::{add, begin};

/// File name suffix of a text in the folder.
pub(super) const ENDING: &str = ".table";
/// Largest size of a text: a table has a few thousand bytes.
const MAX_TABLE_BYTES: u64 = 1 << 20;
const MAGIC: &str = "trabecula text 1";

/// Hash of everything a text depends on; SHA-256, because tools, like volumes, come from anywhere.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TextKey([u8; 32]);

impl TextKey {
    /// The key of these parts and of this build, whose sources determine the result.
    pub fn of(parts: &[&str]) -> TextKey {
        let mut hasher = begin("text");
        parts.iter().for_each(|part| add(&mut hasher, part.as_bytes()));
        TextKey(hasher.finalize().into())
    }

    /// Name of its file.
    pub fn name(self) -> String {
        HEXLOWER.encode(&self.0) + ENDING
    }
}

fn head(key: TextKey, text: &str) -> String {
    let checked = [&key.0, text.as_bytes()].concat();
    format!("{MAGIC} {} {:032x}\n", HEXLOWER.encode(&key.0), xxh3_128(&checked))
}

impl Cache {
    /// Returns the text of a key, checked; `None` if absent.
    ///
    /// # Errors
    /// What is wrong with the file.
    pub fn find_text(&self, key: TextKey) -> Result<Option<String>, Damage> {
        let Some((mut file, bytes)) = self.open_file(&key.name())? else { return Ok(None) };
        if bytes > MAX_TABLE_BYTES {
            return Err(Damage::Length { bytes, expected: MAX_TABLE_BYTES });
        }
        let mut all = String::new();
        Read::by_ref(&mut file).take(MAX_TABLE_BYTES).read_to_string(&mut all).map_err(Damage::Read)?;
        let text = all.split_once('\n').map_or("", |(_, text)| text);
        if all != head(key, text) + text {
            return Err(Damage::Head("wrong checksum"));
        }
        self.mark_used(&file);
        Ok(Some(text.to_owned()))
    }

    /// Caches a text; removes others if the folder would become too large.
    ///
    /// # Errors
    /// The system's error.
    pub fn keep_text(&self, key: TextKey, text: &str) -> io::Result<()> {
        let head = head(key, text);
        let bytes = (head.len() + text.len()) as u64;
        if bytes > MAX_TABLE_BYTES {
            return Err(io::ErrorKind::FileTooLarge.into());
        }
        self.write(&key.name(), bytes, |file| {
            file.write_all(head.as_bytes())?;
            file.write_all(text.as_bytes())
        })
    }

    /// Path of a key's text.
    pub fn path_of_text(&self, key: TextKey) -> PathBuf {
        self.path.join(key.name())
    }

    /// Removes an invalid text.
    pub fn remove_text(&self, key: TextKey) {
        self.remove(&key.name());
    }
}
