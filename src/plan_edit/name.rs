//! Validated name of a scene file chosen in the page.

use std::ffi::OsStr;
use std::path::{Path, PathBuf};

/// Maximum length in bytes; file systems allow 255.
const LONGEST: usize = 120;

/// A file name that ends in `.toml` and cannot leave the folder it is joined to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SceneName(String);

/// Error for an invalid name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "invalid name `{}`; expected letters, digits, spaces, `.`, `-` and `_`, a letter or digit first, \
     `.toml` last, at most {LONGEST} bytes",
    foreign_text::foreign(.0)
)]
pub struct NameError(String);

impl SceneName {
    /// Checks a name and appends `.toml` if missing.
    ///
    /// # Errors
    /// [`NameError`]: other characters, such as a path separator, a leading dot, or too long.
    pub fn parse(given: &str) -> Result<SceneName, NameError> {
        let given = given.trim();
        let name = if given.ends_with(".toml") { given.to_owned() } else { format!("{given}.toml") };
        let is_allowed = |sign: char| sign.is_alphanumeric() || " .-_".contains(sign);
        let is_name = name.starts_with(char::is_alphanumeric)
            && name.chars().all(is_allowed)
            && name.len() <= LONGEST
            && Path::new(&name).file_name() == Some(OsStr::new(&name));
        if is_name { Ok(SceneName(name)) } else { Err(NameError(given.to_owned())) }
    }

    /// Returns the path of this name in a folder.
    pub fn within(&self, folder: &Path) -> PathBuf {
        folder.join(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_leads_nowhere_else() {
        let folder = Path::new("/scenes");
        for (given, file) in [
            ("hip.toml", "/scenes/hip.toml"),
            (" Hüfte 2-b ", "/scenes/Hüfte 2-b.toml"),
            ("a..b", "/scenes/a..b.toml"),
        ] {
            assert_eq!(SceneName::parse(given).unwrap().within(folder), Path::new(file));
        }
        let long = "a".repeat(LONGEST);
        for given in [
            "",
            ".",
            "..",
            "../a.toml",
            "/a.toml",
            "a/b.toml",
            "a\\b.toml",
            ".a.toml",
            "a\0.toml",
            "a\n.toml",
            "-a",
            &long,
        ] {
            assert!(SceneName::parse(given).is_err(), "{given:?}");
        }
    }
}
