//! The header of a log: what was run, by which build, with which message layouts.

use std::collections::BTreeMap;
use std::path::Path;

use messages::Tick;
use messages::layout::{Description, hex};

use sha2::{Digest, Sha256};

use crate::error::LogError;
use crate::seal::{is_unbroken, seal};

/// Version of the log's structure (topics, metadata, chunk rules). Readers refuse any other version.
pub const FORMAT_VERSION: u32 = 1;
/// Name of the metadata record that holds the header.
pub const HEADER_RECORD: &str = "trabecula";
/// Name of the attachment that holds the scene.
pub const SCENE_ATTACHMENT: &str = "scene.toml";
/// Name of the attachment that holds the scene's C-arm calibration, and of the session-folder file that it is
/// copied from.
pub const CALIBRATION_ATTACHMENT: &str = "calibration.json";

/// Name of the metadata record in a file of several runs (`join`): the number of runs and their names.
pub const RUNS_RECORD: &str = "runs";

/// Entry of a log that begins later than its run. Earlier builds ignore it and report a gap.
const FIRST_TICK: &str = "first_tick";

/// How the run's ticks were paced.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunMode {
    /// Each tick waited for every controller.
    Lockstep,
    /// Ticks followed the wall clock.
    RealTime,
}

impl RunMode {
    /// The mode's name in the header.
    pub fn name(self) -> &'static str {
        match self {
            RunMode::Lockstep => "lockstep",
            RunMode::RealTime => "realtime",
        }
    }
}

/// The build that wrote the log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BuildInfo {
    /// Version of the hub, `+`, and a hash of all source code that decides a tick.
    pub version: String,
    /// Target triple.
    pub target: String,
    /// `rustc --version`, if known.
    pub rustc: Option<String>,
}

/// Description of the logged run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogHeader {
    /// The scene file's text, exactly as run.
    pub scene_toml: String,
    /// The scene's C-arm as JSON, with the fields of `CArmGeometry`; `None` without X-ray.
    pub calibration_json: Option<String>,
    /// The scene's name.
    pub scene_name: String,
    /// SHA-256 of the CT volume; `None` if the scene has no volume.
    pub volume_sha256: Option<[u8; 32]>,
    /// Size of the volume in voxels along i, j, k; zeros without a volume.
    pub volume_dimensions: [u32; 3],
    /// Length of a tick in simulated time.
    pub dt_ns: u64,
    /// How the run's ticks were paced.
    pub mode: RunMode,
    /// The scene's controllers, in order.
    pub controllers: Vec<String>,
    /// The build that wrote the log.
    pub build: BuildInfo,
    /// Tick of the keyframe at which the log begins; [`Tick::START`] for a log from the run's start.
    pub first_tick: Tick,
}

/// Layout hash of every message in this build, by short name.
pub fn layout_hashes() -> BTreeMap<String, String> {
    let hash = |d: &&Description| (d.short_name().to_string(), d.layout_hash());
    messages::ALL.iter().map(hash).collect()
}

impl LogHeader {
    /// SHA-256 of the scene text, in hexadecimal.
    pub fn scene_sha256(&self) -> String {
        hex(&Sha256::digest(self.scene_toml.as_bytes()))
    }

    /// Returns the header as entries of its metadata record; `lane` is `run` or `timing`.
    pub fn to_metadata(&self, lane: &str) -> BTreeMap<String, String> {
        let dimensions = self.volume_dimensions.map(|n| n.to_string()).join(" ");
        let volume = self.volume_sha256.map(|digest| hex(&digest)).unwrap_or_default();
        let mut entries = BTreeMap::new();
        let mut put = |key: &str, value: String| entries.insert(key.to_string(), value);
        put("format_version", FORMAT_VERSION.to_string());
        put("lane", lane.to_string());
        put("scene_name", self.scene_name.clone());
        put("scene_sha256", self.scene_sha256());
        put("volume_sha256", volume);
        put("volume_dimensions", dimensions);
        put("dt_ns", self.dt_ns.to_string());
        put("mode", self.mode.name().to_string());
        put("controllers", self.controllers.join("\n"));
        put("build_version", self.build.version.clone());
        put("target", self.build.target.clone());
        put("rustc", self.build.rustc.clone().unwrap_or_default());
        if self.first_tick > Tick::START {
            put(FIRST_TICK, self.first_tick.to_string());
        }
        for (message, hash) in layout_hashes() {
            put(&format!("layout/{message}"), hash);
        }
        seal(&mut entries);
        entries
    }

    /// Parses the header. The scene's text and the calibration come from the attachments.
    pub fn from_metadata(
        path: &Path,
        entries: &BTreeMap<String, String>,
        scene_toml: String,
        calibration_json: Option<String>,
    ) -> Result<LogHeader, LogError> {
        let unbroken = is_unbroken(entries);
        let entries = Entries { path, record: HEADER_RECORD, entries };
        if !unbroken {
            return Err(entries.wrong("crc32", "the checksum of the other entries"));
        }
        let version: u32 = entries.number("format_version", "a number")?;
        if version != FORMAT_VERSION {
            return Err(entries.wrong("format_version", "1 (another build wrote this log: use that build)"));
        }
        let header = LogHeader {
            scene_toml,
            calibration_json,
            scene_name: entries.text("scene_name")?.to_string(),
            volume_sha256: entries.digest("volume_sha256")?,
            volume_dimensions: entries.dimensions("volume_dimensions")?,
            dt_ns: entries.number("dt_ns", "nanoseconds above 0")?,
            mode: match entries.text("mode")? {
                "lockstep" => RunMode::Lockstep,
                "realtime" => RunMode::RealTime,
                _ => return Err(entries.wrong("mode", "lockstep or realtime")),
            },
            controllers: entries.text("controllers")?.lines().map(str::to_string).collect(),
            build: BuildInfo {
                version: entries.text("build_version")?.to_string(),
                target: entries.text("target")?.to_string(),
                rustc: Some(entries.text("rustc")?.to_string()).filter(|text| !text.is_empty()),
            },
            first_tick: match entries.entries.contains_key(FIRST_TICK) {
                true => Tick(entries.number(FIRST_TICK, "a number")?),
                false => Tick::START,
            },
        };
        if header.dt_ns == 0 {
            return Err(entries.wrong("dt_ns", "nanoseconds above 0"));
        }
        if header.scene_sha256() != entries.text("scene_sha256")? {
            return Err(entries.wrong("scene_sha256", "the SHA-256 of the attached scene.toml"));
        }
        Ok(header)
    }
}

/// Refuses a log in which any message layout differs from this build's.
pub(crate) fn check_layouts(
    path: &Path,
    metadata: &BTreeMap<String, String>,
    header: &LogHeader,
) -> Result<(), LogError> {
    match other_layout(metadata) {
        None => Ok(()),
        Some((message, log, build)) => {
            let version = header.build.version.clone();
            Err(LogError::Layout { path: path.into(), message, log, build, version })
        }
    }
}

/// Returns the first message whose layout differs from this build's: its name, the log's hash, this build's
/// hash.
pub(crate) fn other_layout(metadata: &BTreeMap<String, String>) -> Option<(String, String, String)> {
    let build = layout_hashes();
    let of_log = metadata.iter().filter_map(|(key, hash)| Some((key.strip_prefix("layout/")?, hash)));
    let with_ours =
        of_log.map(|(message, log)| (message, log, build.get(message).cloned().unwrap_or_default()));
    let mut others = with_ours.filter(|(_, log, ours)| ours != *log);
    others.next().map(|(message, log, ours)| (message.to_string(), log.clone(), ours))
}

/// Entries of a metadata record, with the context for error messages.
pub(crate) struct Entries<'a> {
    pub path: &'a Path,
    pub record: &'static str,
    pub entries: &'a BTreeMap<String, String>,
}

impl Entries<'_> {
    pub fn wrong(&self, key: &str, expected: &'static str) -> LogError {
        let value = self.entries.get(key).cloned().unwrap_or_default();
        LogError::Metadata {
            path: self.path.into(),
            record: self.record,
            key: key.to_string(),
            value,
            expected,
        }
    }

    pub fn text(&self, key: &str) -> Result<&str, LogError> {
        self.entries.get(key).map(String::as_str).ok_or_else(|| self.wrong(key, "an entry"))
    }

    pub fn number<T: std::str::FromStr>(&self, key: &str, expected: &'static str) -> Result<T, LogError> {
        self.text(key)?.parse().map_err(|_| self.wrong(key, expected))
    }

    fn digest(&self, key: &str) -> Result<Option<[u8; 32]>, LogError> {
        let text = self.text(key)?;
        if text.is_empty() {
            return Ok(None);
        }
        let wrong = || self.wrong(key, "64 hexadecimal digits or nothing");
        let mut digest = [0u8; 32];
        if text.len() != 64 || !text.is_ascii() {
            return Err(wrong());
        }
        for (i, byte) in digest.iter_mut().enumerate() {
            *byte = u8::from_str_radix(&text[2 * i..2 * i + 2], 16).map_err(|_| wrong())?;
        }
        Ok(Some(digest))
    }

    fn dimensions(&self, key: &str) -> Result<[u32; 3], LogError> {
        let parsed: Result<Vec<u32>, _> = self.text(key)?.split(' ').map(str::parse).collect();
        let numbers = parsed.map_err(|_| self.wrong(key, "three numbers"))?;
        numbers.try_into().map_err(|_| self.wrong(key, "three numbers"))
    }
}
