//! A checksum of a metadata record's own. MCAP has none: a changed bit is known only at the end of a file that has one.

use std::collections::BTreeMap;

/// The entry that holds it.
pub(crate) const SEAL: &str = "crc32";

/// Puts the checksum of the entries among them.
pub(crate) fn seal(entries: &mut BTreeMap<String, String>) {
    let checksum = of(entries);
    entries.insert(SEAL.to_owned(), checksum);
}

/// Whether the entries are what was sealed. Records of earlier builds have no seal.
pub(crate) fn is_unbroken(entries: &BTreeMap<String, String>) -> bool {
    entries.get(SEAL).is_none_or(|told| *told == of(entries))
}

/// Whether they have a seal.
pub(crate) fn is_sealed(entries: &BTreeMap<String, String>) -> bool {
    entries.contains_key(SEAL)
}

/// Of keys and values with their lengths, in the order of the keys, without the seal itself.
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
