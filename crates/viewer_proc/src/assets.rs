//! The page's files: built into the program, or read from a folder during development of the page.

use std::borrow::Cow;
use std::path::{Path, PathBuf};

include!(concat!(env!("OUT_DIR"), "/assets.rs"));

/// A file of the page.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Asset {
    /// Value of the Content-Type header.
    pub media_type: &'static str,
    /// Content.
    pub bytes: Cow<'static, [u8]>,
}

/// Returns the file at a URL path, or `None` if there is none; `/` is the page itself.
pub fn asset(path: &str, folder: Option<&Path>) -> Option<Asset> {
    let path = path.split(['?', '#']).next().unwrap_or(path);
    let name = if path == "/" { "index.html" } else { path.strip_prefix('/')? };
    let embedded = FILES.iter().find(|(known, _)| *known == name);
    let bytes = match folder {
        None => Cow::Borrowed(embedded?.1),
        Some(folder) => Cow::Owned(std::fs::read(inside(folder, name)?).ok()?),
    };
    Some(Asset { media_type: media_type(name), bytes })
}

/// Returns the path inside the folder, or `None` if it would escape the folder.
fn inside(folder: &Path, name: &str) -> Option<PathBuf> {
    let plain = name.split('/').all(|part| !part.is_empty() && !part.starts_with('.'));
    plain.then(|| folder.join(name))
}

fn media_type(name: &str) -> &'static str {
    match name.rsplit('.').next().unwrap_or("") {
        "html" => "text/html; charset=utf-8",
        "js" | "mjs" => "text/javascript; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "json" => "application/json",
        "svg" => "image/svg+xml",
        "png" => "image/png",
        "txt" | "md" => "text/plain; charset=utf-8",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_path_leaves_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let page = folder.path().join("page");
        std::fs::create_dir_all(page.join("assets")).unwrap();
        std::fs::write(page.join("assets/a.js"), "1").unwrap();
        std::fs::write(folder.path().join("secret"), "2").unwrap();
        assert_eq!(asset("/assets/a.js", Some(&page)).unwrap().bytes.as_ref(), b"1");
        for path in
            ["/../secret", "/assets/../../secret", "//secret", "/.secret", "secret", "/./assets/a.js", ""]
        {
            assert_eq!(asset(path, Some(&page)), None, "{path}");
            assert_eq!(asset(path, None), None, "{path}");
        }
    }

    #[test]
    fn the_page_is_in_the_program() {
        let page = asset("/", None).unwrap();
        assert_eq!(page.media_type, "text/html; charset=utf-8");
        assert!(page.bytes.starts_with(b"<!"));
    }
}
