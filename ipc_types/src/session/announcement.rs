//! `session.json`: what the host announces to programs that join.

use std::collections::BTreeMap;
use std::os::fd::OwnedFd;
use std::path::Path;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::folder::read_file;
use super::places::SearchedPlaces;
use super::{ICEORYX2_VERSION, SessionError};
use crate::messages::services;
use crate::scene::{Policy, Wait};

/// File name of the announcement.
pub(crate) const ANNOUNCEMENT_FILE: &str = "session.json";
const RETRY_TIME: Duration = Duration::from_millis(5);

/// Contents of `session.json`.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Announcement {
    /// Process number of the host.
    pub pid: u32,
    /// Version of the transport.
    pub iceoryx2: String,
    /// Version of the hub.
    pub trabecula: String,
    /// Layout hash of each service.
    pub layouts: BTreeMap<String, String>,
    /// Controllers in the scene's order.
    pub controllers: Vec<String>,
    /// Size of the volume message, bytes; 0 without a volume.
    pub volume_bytes: usize,
    /// Size of a frame message, bytes; 0 without DRR.
    pub frame_bytes: usize,
    /// Whether a recorder takes part; if so, the physics waits for it.
    pub recorder: bool,
    /// How physics and controllers wait for each other.
    pub wait: Wait,
    /// How physics and controllers are scheduled.
    pub policy: Policy,
}

/// Waits for the announcement in a session's open folder.
pub(crate) fn await_announcement(
    folder: &OwnedFd,
    path: &Path,
    limit: Duration,
) -> Result<Announcement, SessionError> {
    let file = path.join(ANNOUNCEMENT_FILE);
    let end = Instant::now() + limit;
    loop {
        match read_file(folder, ANNOUNCEMENT_FILE) {
            Ok(text) => return announcement_of(&text, path, &file),
            Err(_) if path.is_dir() && Instant::now() < end => std::thread::sleep(RETRY_TIME),
            Err(_) => return Err(SessionError::NoSession { searched: SearchedPlaces::folder(path) }),
        }
    }
}

/// Checks the versions first, because another version's file may have other fields.
fn announcement_of(text: &str, folder: &Path, path: &Path) -> Result<Announcement, SessionError> {
    let malformed = |cause: serde_json::Error| SessionError::File {
        path: path.to_owned(),
        cause: std::io::Error::other(cause),
    };
    let value: serde_json::Value = serde_json::from_str(text).map_err(malformed)?;
    let theirs = |key: &str| value[key].as_str().unwrap_or("of an unknown version").to_owned();
    let path = folder.to_owned();
    if theirs("iceoryx2") != ICEORYX2_VERSION {
        return Err(SessionError::Transport { path, theirs: theirs("iceoryx2") });
    }
    if theirs("trabecula") != env!("CARGO_PKG_VERSION") {
        return Err(SessionError::Version { path, theirs: theirs("trabecula") });
    }
    serde_json::from_value(value).map_err(malformed)
}

/// Compares the layout of each of the hub's services with this program's.
pub(crate) fn check_layouts(announcement: &Announcement) -> Result<(), SessionError> {
    for (name, theirs) in &announcement.layouts {
        let kind = name.split('/').next().unwrap_or(name);
        let service = services::ALL.iter().chain([&services::COMMAND]).find(|service| service.name == kind);
        let Some(service) = service else { continue };
        let ours = service.description.layout_hash();
        if *theirs != ours {
            let message = service.description.name;
            return Err(SessionError::Layout {
                service: name.clone(),
                message,
                theirs: theirs.clone(),
                ours,
            });
        }
    }
    Ok(())
}
