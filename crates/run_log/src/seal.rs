//! Adds a checksum to a metadata record. MCAP has none there, so a flipped bit would show only in the
//! checksum at the end of the file.

use std::collections::BTreeMap;

/// Name of the entry that holds the checksum.
pub(crate) const SEAL: &str = "crc32";

/// Adds an entry with the checksum of all other entries.
pub(crate) fn seal(entries: &mut BTreeMap<String, String>) {
    let checksum = of(entries);
    entries.insert(SEAL.to_owned(), checksum);
}

/// Returns whether the checksum is right, or absent as in records of earlier builds.
pub(crate) fn is_unbroken(entries: &BTreeMap<String, String>) -> bool {
    entries.get(SEAL).is_none_or(|told| *told == of(entries))
}

/// Returns whether the entries include a checksum.
pub(crate) fn is_sealed(entries: &BTreeMap<String, String>) -> bool {
    entries.contains_key(SEAL)
}

/// Checksum of keys and values with their lengths, in key order, without the seal itself.
fn of(entries: &BTreeMap<String, String>) -> String {
    let mut hasher = crc32fast::Hasher::new();
    for (key, value) in entries.iter().filter(|(key, _)| *key != SEAL) {
        for text in [key, value] {
            hasher.update(&(text.len() as u64).to_le_bytes());
            hasher.update(text.as_bytes());
        }
    }
    format!("{:08x}", hasher.finalize())
}
