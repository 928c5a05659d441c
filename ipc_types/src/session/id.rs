//! Session names: random, so that other users cannot create files under one in advance.

use std::fmt::{self, Display, Formatter};
use std::path::Path;

use foreign_text::foreign_path;

use super::places::last_name;
use super::{ANNOUNCEMENT_FILE, SessionError};

/// A session's name: [`SessionId::LENGTH`] letters and digits from the system's random number generator.
///
/// It cannot be guessed, so nothing can be planted under the names a session will use. It also differs
/// between two hubs with the same process number, in two containers that share `/dev/shm`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SessionId(String);

const DIGITS: &[u8; 62] = b"0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz";

impl SessionId {
    /// 62^11 is more than 2^64.
    pub const LENGTH: usize = 11;

    /// Draws a new random name.
    ///
    /// # Errors
    /// [`SessionError::NoRandomness`].
    pub(crate) fn random() -> Result<SessionId, SessionError> {
        let mut text = String::with_capacity(SessionId::LENGTH);
        while text.len() < SessionId::LENGTH {
            let mut bytes = [0; 4 * SessionId::LENGTH];
            getrandom::fill(&mut bytes)
                .map_err(|cause| SessionError::NoRandomness { cause: cause.to_string() })?;
            // Six bits per digit. Values beyond the 62 digits are skipped, so that all digits are equally
            // likely.
            let digits = bytes.iter().filter_map(|byte| DIGITS.get(usize::from(byte & 63)));
            text.extend(digits.map(|digit| char::from(*digit)));
        }
        text.truncate(SessionId::LENGTH);
        Ok(SessionId(text))
    }

    /// Parses a session name; `None` if it is malformed.
    pub fn parse(name: &str) -> Option<SessionId> {
        let fits = name.len() == SessionId::LENGTH && name.bytes().all(|byte| byte.is_ascii_alphanumeric());
        fits.then(|| SessionId(name.to_owned()))
    }

    /// Returns the session that a folder belongs to, by its name.
    pub fn of(folder: &Path) -> Option<SessionId> {
        last_name(folder).and_then(SessionId::parse)
    }

    /// Checks whether a name or folder could ever be a session's; if not, waiting for it is pointless.
    ///
    /// # Errors
    /// [`SessionError::NotASession`] if no hub gives such a name and no other version has announced itself
    /// there.
    pub fn can_be(folder: &Path) -> Result<(), SessionError> {
        match SessionId::of(folder).is_some() || folder.join(ANNOUNCEMENT_FILE).exists() {
            true => Ok(()),
            false => Err(SessionError::NotASession { given: foreign_path(folder) }),
        }
    }

    /// Returns the prefix of its shared-memory names; it contains the transport's version.
    pub fn shared_memory_prefix(&self) -> String {
        prefix_of(&self.0)
    }
}

/// Returns the prefix for a session's name; the message reference shows it for `<name of the folder>`.
pub(crate) fn prefix_of(name: &str) -> String {
    format!("trabecula010_{name}_")
}

/// Length of [`SessionId::shared_memory_prefix`], bytes.
pub(crate) const PREFIX_LENGTH: usize = "trabecula010_".len() + SessionId::LENGTH + "_".len();

impl Display for SessionId {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_random_and_only_exact_ones_are_taken() {
        let ids: Vec<SessionId> = (0..100).map(|_| SessionId::random().unwrap()).collect();
        for (index, id) in ids.iter().enumerate() {
            assert_eq!(SessionId::parse(&id.to_string()).as_ref(), Some(id));
            assert_eq!(id.shared_memory_prefix().len(), PREFIX_LENGTH);
            assert!(!ids[..index].contains(id));
        }
        for name in [
            "",
            "src",
            "4194305-0",
            "0123456789",
            "0123456789Ab",
            "0123456789/",
            "0123456789ä",
            ".0123456789",
        ] {
            assert_eq!(SessionId::parse(name), None, "{name}");
        }
        assert!(SessionId::of(Path::new("/tmp/trabecula-hubs-0/0123456789a")).is_some());
        assert!(SessionId::of(Path::new("/tmp/0123456789a/..")).is_none());
    }
}
