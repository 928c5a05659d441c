//! Cache, in the user's cache folder, of volumes that are slow to generate or decode, and of measured tables
//! of tools.
//!
//! The folder is `trabecula` in `$XDG_CACHE_HOME`, or in `$HOME/.cache`. It is used only if it belongs to
//! this user and is closed to others (mode 700), and each of its files ([`mod@entry`]) only after its whole
//! content was checked: a damaged one is reported, removed and rebuilt. A file gets its name only when it is
//! complete and on disk, so a partial file is never visible. Without such a folder, on a full disk, or in a
//! read-only folder, everything works as without a cache.
//!
//! **Invariant:** a volume from the cache is bitwise identical to a rebuilt one: its name is a hash of
//! everything it is built from ([`mod@key`]), including this build. The same holds for a table
//! ([`mod@text`]).

pub mod entry;
pub mod key;
mod shared_work;
pub mod text;

use std::fs::{DirBuilder, File};
use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use std::time::{Duration, Instant, SystemTime};

use ipc_types::session::{PlaceError, open_private};
use rustix::fs::{AtFlags, CWD, Dir, FileType, Mode, OFlags, Stat, Timespec, Timestamps, UTIME_NOW};
use rustix::io::Errno;
use volume_io::VolumeError;
use voxel_grid::Volume;

use entry::Damage;
use key::Key;

use crate::volume_source::VolumeWithNotes;

/// Size limit of the folder; beyond it, the least recently used files are removed.
pub const LIMIT_BYTES: u64 = 2 << 30;
/// Volumes that are built faster than this are not cached: reading and checking them would take as long.
const WORTH_KEEPING: Duration = Duration::from_millis(100);
/// File name suffix in the folder.
const ENDING: &str = ".volume";

/// Callback for warnings: they concern this machine, not a volume, so no result carries them.
static REMARKS: OnceLock<fn(&str)> = OnceLock::new();

/// Sets the callback for cache warnings (silent by default). Only the first call takes effect.
pub fn tell_remarks_by(tell: fn(&str)) {
    let _ = REMARKS.set(tell);
}

pub(crate) fn remark(text: &str) {
    if let Some(tell) = REMARKS.get() {
        tell(text);
    }
}

/// Returns this user's cache folder from the environment; `None` without a home.
pub fn place() -> Option<PathBuf> {
    let absolute = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|path| path.is_absolute());
    // Relative paths must be ignored (XDG Base Directory Specification 0.8).
    let above = absolute("XDG_CACHE_HOME").or_else(|| Some(absolute("HOME")?.join(".cache")));
    above.map(|above| above.components().collect::<PathBuf>().join("trabecula"))
}

/// Returns the volume of a key: from the cache, or built and then cached.
///
/// # Errors
/// Any error of `make`. Cache problems are never errors.
pub fn through(
    key: &Key,
    make: impl FnOnce() -> Result<(Volume, Vec<String>), VolumeError>,
) -> Result<VolumeWithNotes, VolumeError> {
    let opened = place().map(|path| Cache::open(&path).map_err(|cause| (path, cause)));
    match opened {
        Some(Ok(cache)) => through_folder(&cache, key, make),
        Some(Err((path, cause))) => {
            let is_to_say = !matches!(cause, PlaceError::System(_) | PlaceError::Missing);
            if is_to_say {
                remark(&format!("{}: unusable as a cache folder: {cause}", path.display()));
            }
            fresh(make)
        }
        None => fresh(make),
    }
}

/// Builds a volume without the cache.
///
/// # Errors
/// Any error of `make`.
pub fn fresh(
    make: impl FnOnce() -> Result<(Volume, Vec<String>), VolumeError>,
) -> Result<VolumeWithNotes, VolumeError> {
    let (volume, notes) = make()?;
    Ok(VolumeWithNotes::of(volume, notes))
}

fn through_folder(
    cache: &Cache,
    key: &Key,
    make: impl FnOnce() -> Result<(Volume, Vec<String>), VolumeError>,
) -> Result<VolumeWithNotes, VolumeError> {
    match cache.find(key) {
        Ok(Some(made)) => return Ok(made),
        Ok(None) => {}
        Err(damage) => {
            remark(&format!("{}: {damage}; rebuilding it", cache.file(key).display()));
            cache.remove(&key.name());
        }
    }
    let began = Instant::now();
    let (volume, notes) = make()?;
    if began.elapsed() < WORTH_KEEPING || !key.is_current() {
        return Ok(VolumeWithNotes::of(volume, notes));
    }
    Ok(cache.keep(key, volume, notes))
}

/// The cache folder, open.
#[derive(Debug)]
pub struct Cache {
    path: PathBuf,
    folder: OwnedFd,
    limit_bytes: u64,
}

/// A file of the cache.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct CachedFile {
    /// Its name in the folder.
    pub name: String,
    /// Its length.
    pub bytes: u64,
    /// When it was last used.
    pub used: SystemTime,
}

impl CachedFile {
    /// Whether it is a table of measured errors; otherwise it is a volume, or an unfinished file.
    pub fn is_table(&self) -> bool {
        self.name.ends_with(text::ENDING)
    }
}

impl Cache {
    /// Opens the folder; creates it and its parents if they are missing.
    ///
    /// # Errors
    /// Why it cannot be used.
    pub fn open(path: &Path) -> Result<Cache, PlaceError> {
        let folder = match open_private(CWD, path) {
            Err(PlaceError::Missing) => {
                let made = DirBuilder::new().recursive(true).mode(0o700).create(path);
                made.map_err(|cause| PlaceError::System(Errno::from_io_error(&cause).unwrap_or(Errno::IO)))?;
                open_private(CWD, path)?
            }
            other => other?,
        };
        Ok(Cache { path: path.to_owned(), folder, limit_bytes: LIMIT_BYTES })
    }

    /// Opens the folder if it exists; creates nothing.
    ///
    /// # Errors
    /// Why it cannot be used.
    pub fn open_existing(path: &Path) -> Result<Cache, PlaceError> {
        Ok(Cache { path: path.to_owned(), folder: open_private(CWD, path)?, limit_bytes: LIMIT_BYTES })
    }

    fn file(&self, key: &Key) -> PathBuf {
        self.path.join(key.name())
    }

    /// Returns the volume of a key, checked; `None` if absent.
    ///
    /// # Errors
    /// What is wrong with the file.
    pub fn find(&self, key: &Key) -> Result<Option<VolumeWithNotes>, Damage> {
        let Some((file, bytes)) = self.open_file(&key.name())? else { return Ok(None) };
        let made = entry::read(&file, bytes, key)?;
        self.mark_used(&file);
        Ok(Some(made))
    }

    /// Opens a cached file and returns it with its length, or `None` if absent.
    fn open_file(&self, name: &str) -> Result<Option<(File, u64)>, Damage> {
        // The flags avoid following links and blocking on pipes.
        let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let file = match rustix::fs::openat(&self.folder, name, flags, Mode::empty()) {
            Ok(file) => File::from(file),
            Err(Errno::NOENT) => return Ok(None),
            Err(Errno::LOOP | Errno::NXIO) => return Err(Damage::NotAFile),
            Err(cause) => return Err(Damage::Read(cause.into())),
        };
        let stat = rustix::fs::fstat(&file).map_err(|cause| Damage::Read(cause.into()))?;
        if !is_own_file(&stat) {
            return Err(Damage::NotAFile);
        }
        Ok(Some((file, u64::try_from(stat.st_size).unwrap_or(0))))
    }

    /// Marks a file as just used; if that fails, it is only removed earlier.
    fn mark_used(&self, file: &File) {
        let now = Timespec { tv_sec: 0, tv_nsec: UTIME_NOW };
        let _ = rustix::fs::futimens(file, &Timestamps { last_access: now, last_modification: now });
    }

    /// Caches a volume, and removes others if the folder would become too large. Returns it with its hash,
    /// even if it cannot be cached; then the folder keeps its content, except for what was removed.
    fn keep(&self, key: &Key, volume: Volume, notes: Vec<String>) -> VolumeWithNotes {
        entry::write_and_hash(key, volume, notes, |bytes, write| {
            self.write(&key.name(), bytes, |file| write(&file.handle().map_err(io::Error::other)?))
        })
    }

    /// Writes a file of a given name and length.
    fn write(
        &self,
        name: &str,
        bytes: u64,
        write: impl FnOnce(&mut output_file::OutputFile) -> io::Result<()>,
    ) -> io::Result<()> {
        if bytes > self.limit_bytes {
            return Err(io::ErrorKind::FileTooLarge.into());
        }
        // An equal amount of space stays free: a cache must not fill the disk.
        let disk = rustix::fs::fstatvfs(&self.folder)?;
        if disk.f_blocks > 0 && disk.f_bavail.saturating_mul(disk.f_frsize) < 2 * bytes {
            return Err(io::ErrorKind::StorageFull.into());
        }
        self.make_room(bytes);
        let mut file = output_file::OutputFile::create(&self.path.join(name)).map_err(io::Error::other)?;
        write(&mut file)?;
        // A concurrent run may have been faster; its file is the same.
        file.keep().map_err(io::Error::other)
    }

    fn make_room(&self, bytes: u64) {
        let mut files = self.files();
        files.sort_by(|a, b| (a.used, &a.name).cmp(&(b.used, &b.name)));
        let mut total: u64 = files.iter().map(|file| file.bytes).sum();
        for file in files {
            if total + bytes <= self.limit_bytes {
                break;
            }
            self.remove(&file.name);
            total -= file.bytes;
        }
    }

    /// The volumes and tables in the folder, and unfinished files of killed programs.
    pub fn files(&self) -> Vec<CachedFile> {
        let entries = Dir::read_from(&self.folder).into_iter().flatten().flatten();
        let names = entries.filter_map(|entry| entry.file_name().to_str().ok().map(str::to_owned));
        names.filter(|name| is_our_name(name)).filter_map(|name| self.file_of(name)).collect()
    }

    fn file_of(&self, name: String) -> Option<CachedFile> {
        let stat = rustix::fs::statat(&self.folder, &name, AtFlags::SYMLINK_NOFOLLOW).ok()?;
        let used = Duration::from_secs(u64::try_from(stat.st_mtime).unwrap_or(0));
        is_own_file(&stat).then(|| CachedFile {
            name,
            bytes: u64::try_from(stat.st_size).unwrap_or(0),
            used: SystemTime::UNIX_EPOCH + used,
        })
    }

    /// Removes every volume and table of the cache, and nothing else. Returns the number of files and bytes
    /// removed.
    pub fn clear(&self) -> (usize, u64) {
        let removed: Vec<CachedFile> =
            self.files().into_iter().filter(|file| self.remove(&file.name)).collect();
        (removed.len(), removed.iter().map(|file| file.bytes).sum())
    }

    /// Removes a name; true also if it is already gone.
    fn remove(&self, name: &str) -> bool {
        rustix::fs::unlinkat(&self.folder, name, AtFlags::empty()).is_ok()
    }
}

fn is_own_file(stat: &Stat) -> bool {
    FileType::from_raw_mode(stat.st_mode) == FileType::RegularFile
        && stat.st_uid == rustix::process::geteuid().as_raw()
        && stat.st_nlink == 1
}

/// Whether a name is that of a volume, a table, or an unfinished file of one.
fn is_our_name(name: &str) -> bool {
    let hash = [ENDING, text::ENDING].into_iter().find_map(|ending| name.strip_suffix(ending));
    hash.is_some_and(|hash| hash.len() == 64 && hash.bytes().all(|byte| byte.is_ascii_hexdigit()))
        || name.starts_with(output_file::DRAFT_PREFIX)
}

#[cfg(test)]
mod tests;
