//! Tests of the cache, including attacks on it.

use std::fs::{self, Permissions};
use std::os::unix::fs::{PermissionsExt, symlink};
use std::time::Duration;

use super::*;
use volume_io::ReadOptions;
use voxel_grid::VoxelGrid;

fn volume(value: i16) -> Volume {
    Volume { grid: grid([3, 4, 5]), hu: (0..60).map(|index| value + index).collect() }
}

fn grid(dims: [usize; 3]) -> VoxelGrid {
    let axes = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
    VoxelGrid::new(dims, [0.5e-3, 1e-3, 2e-3], [0.1, -0.2, 0.3], axes).unwrap()
}

fn made(value: i16) -> VolumeWithNotes {
    VolumeWithNotes::of(volume(value), vec!["1 value clamped".to_owned()])
}

fn key(number: i16) -> Key {
    Key::of_phantom("test", &number)
}

struct Place {
    folder: tempfile::TempDir,
    cache: Cache,
}

impl Place {
    fn new() -> Place {
        let folder = tempfile::tempdir().unwrap();
        let cache = Cache::open(&folder.path().join("a/b/trabecula")).unwrap();
        Place { folder, cache }
    }

    fn keep(&self, number: i16) -> PathBuf {
        let kept = self.cache.keep(&key(number), volume(number), made(number).notes);
        assert_eq!(kept.ct.sha256, made(number).ct.sha256);
        self.cache.file(&key(number))
    }

    fn age(&self, number: i16, hours: u64) {
        let file = File::options().write(true).open(self.cache.file(&key(number))).unwrap();
        file.set_modified(SystemTime::now() - Duration::from_secs(3600 * hours)).unwrap();
    }

    fn finds(&self, number: i16) -> bool {
        self.cache.find(&key(number)).unwrap().is_some()
    }
}

#[test]
fn what_was_kept_is_found_to_the_bit_by_its_key_alone() {
    let place = Place::new();
    place.keep(1);
    let found = place.cache.find(&key(1)).unwrap().unwrap();
    assert_eq!((found.ct, found.notes), (made(1).ct, made(1).notes));
    assert!(!place.finds(2));
    let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o7777;
    assert_eq!(mode(&place.folder.path().join("a/b/trabecula")), 0o700);
}

/// Several threads each read one of several pieces.
#[test]
fn a_volume_of_many_pieces_is_found_to_the_bit_and_two_changed_places_are_seen() {
    let place = Place::new();
    let large = Volume { grid: grid([1000, 1000, 1]), hu: (0..1_000_000).map(|n| (n / 31) as i16).collect() };
    place.cache.keep(&key(1), large.clone(), Vec::new());
    assert_eq!(place.cache.find(&key(1)).unwrap().unwrap().ct.volume, large);
    // Two pieces are swapped: each is intact.
    let path = place.cache.file(&key(1));
    let mut bytes = fs::read(&path).unwrap();
    let voxels = bytes.len() - 2_000_000;
    let (first, second) = bytes[voxels..].split_at_mut(1 << 18);
    first.swap_with_slice(&mut second[..1 << 18]);
    fs::write(&path, bytes).unwrap();
    assert!(matches!(place.cache.find(&key(1)), Err(Damage::Voxels)));
}

/// Every bit of a file is covered by one of the two checksums, and every truncation by its length.
#[test]
fn a_file_with_any_byte_changed_or_missing_is_refused_and_made_anew() {
    let place = Place::new();
    let path = place.keep(1);
    let whole = fs::read(&path).unwrap();
    for index in 0..whole.len() {
        let mut damaged = whole.clone();
        damaged[index] ^= 1 << (index % 8);
        fs::write(&path, damaged).unwrap();
        assert!(place.cache.find(&key(1)).is_err(), "byte {index}");
    }
    for length in (0..whole.len()).chain([whole.len() + 1]) {
        let mut cut = whole.clone();
        cut.resize(length, 0);
        fs::write(&path, cut).unwrap();
        assert!(place.cache.find(&key(1)).is_err(), "{length} bytes");
    }
    let again = through_folder(&place.cache, &key(1), || {
        std::thread::sleep(WORTH_KEEPING);
        Ok((volume(1), vec!["1 value clamped".to_owned()]))
    });
    assert_eq!(again.unwrap().ct.volume, volume(1));
    assert_eq!(fs::read(&path).unwrap(), whole, "written again");
}

/// A header that states more voxels than the file has must not cause their allocation.
#[test]
fn another_volume_under_this_name_and_one_of_enormous_size_are_refused() {
    let place = Place::new();
    let path = place.keep(1);
    fs::copy(place.keep(2), &path).unwrap();
    assert!(place.cache.find(&key(1)).is_err());
    let mut large = made(1);
    large.ct.volume.grid = grid([1 << 16, 1 << 13, 1]);
    let voxels: Vec<u8> = large.ct.volume.hu.iter().flat_map(|hu| hu.to_le_bytes()).collect();
    let sum = entry::sum_of([Ok(xxhash_rust::xxh3::xxh3_128(&voxels))]).unwrap();
    fs::write(&path, [entry::head(&key(1), &large, sum).unwrap(), voxels].concat()).unwrap();
    assert!(matches!(place.cache.find(&key(1)), Err(Damage::Head(_) | Damage::Length { .. })));
}

#[test]
fn links_pipes_and_folders_in_the_place_of_a_file_are_refused_and_their_targets_stay() {
    let place = Place::new();
    let path = place.keep(1);
    let elsewhere = place.folder.path().join("elsewhere");
    fs::rename(&path, &elsewhere).unwrap();
    symlink(&elsewhere, &path).unwrap();
    assert!(matches!(place.cache.find(&key(1)), Err(Damage::NotAFile)));
    assert_eq!(place.cache.clear().0, 0, "links are not cache files");
    fs::remove_file(&path).unwrap();
    fs::hard_link(&elsewhere, &path).unwrap();
    assert!(matches!(place.cache.find(&key(1)), Err(Damage::NotAFile)));
    fs::remove_file(&path).unwrap();
    rustix::fs::mknodat(CWD, &path, FileType::Fifo, Mode::RUSR | Mode::WUSR, 0).unwrap();
    assert!(matches!(place.cache.find(&key(1)), Err(Damage::NotAFile)));
    fs::remove_file(&path).unwrap();
    fs::create_dir(&path).unwrap();
    assert!(place.cache.find(&key(1)).is_err());
    // It cannot be removed, but the volume is still built.
    let made = through_folder(&place.cache, &key(1), || Ok((volume(1), Vec::new()))).unwrap();
    assert_eq!(made.ct.volume, volume(1));
    assert!(elsewhere.exists() && path.is_dir());
}

#[test]
fn a_folder_that_others_can_enter_a_link_and_a_file_are_no_cache() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("trabecula");
    fs::create_dir(&path).unwrap();
    for mode in [0o755, 0o770, 0o701] {
        fs::set_permissions(&path, Permissions::from_mode(mode)).unwrap();
        assert!(matches!(Cache::open(&path), Err(PlaceError::NotPrivate { .. })), "{mode:o}");
    }
    fs::set_permissions(&path, Permissions::from_mode(0o700)).unwrap();
    assert!(Cache::open(&path).is_ok());
    if rustix::process::geteuid().is_root() {
        std::os::unix::fs::chown(&path, Some(65_534), None).unwrap();
        assert!(matches!(Cache::open(&path), Err(PlaceError::NotOwn { .. })));
    }
    let link = folder.path().join("link");
    symlink(&path, &link).unwrap();
    assert!(matches!(Cache::open(&link), Err(PlaceError::Link)));
    fs::write(folder.path().join("file"), "mine").unwrap();
    assert!(Cache::open(&folder.path().join("file")).is_err());
    assert!(Cache::open(&folder.path().join("file/below")).is_err());
    assert_eq!(fs::read(folder.path().join("file")).unwrap(), b"mine");
}

#[test]
fn the_volumes_unused_for_longest_make_room_and_one_too_large_is_not_kept() {
    let mut place = Place::new();
    let bytes = fs::metadata(place.keep(1)).unwrap().len();
    place.keep(2);
    place.keep(3);
    (1..=3).for_each(|number| place.age(number, 4 - number as u64));
    // The oldest one is used again.
    assert!(place.finds(1));
    place.cache.limit_bytes = 3 * bytes;
    place.keep(4);
    assert_eq!([1, 2, 3, 4].map(|number| place.finds(number)), [true, false, true, true]);
    place.cache.limit_bytes = bytes - 1;
    assert!(!place.keep(5).exists());
    assert_eq!(place.cache.files().len(), 3, "nothing was removed for what does not fit");
}

#[test]
fn clearing_removes_volumes_and_unfinished_drafts_and_nothing_else() {
    let place = Place::new();
    place.keep(1);
    let path = |name: &str| place.cache.path.join(name);
    fs::write(path(".trabecula-unfinished-abc"), "half").unwrap();
    let others = ["notes.txt", "abc.volume", "x.volume.bak"];
    others.iter().for_each(|name| fs::write(path(name), "mine").unwrap());
    assert_eq!(place.cache.clear().0, 2);
    assert!(others.iter().all(|name| fs::read(path(name)).unwrap() == b"mine"));
    assert_eq!(place.cache.clear(), (0, 0));
}

#[test]
fn two_that_make_the_same_at_once_both_have_it_and_leave_one_file() {
    let place = Place::new();
    std::thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| {
                let made = through_folder(&place.cache, &key(1), || {
                    std::thread::sleep(WORTH_KEEPING);
                    Ok((volume(1), Vec::new()))
                });
                assert_eq!(made.unwrap().ct.volume, volume(1));
            });
        }
    });
    assert_eq!(fs::read_dir(&place.cache.path).unwrap().count(), 1);
}

#[test]
fn the_key_of_a_file_is_its_content_and_how_it_is_read_and_not_where_or_when() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ct.nii.gz");
    let write = |path: &Path, value: i16| {
        let volume = Volume { grid: grid([4; 3]), hu: vec![value; 64] };
        volume_io::write_nifti(path, &volume).unwrap();
    };
    write(&path, 1);
    let options = ReadOptions::default();
    let of = |path: &Path| Key::of_file(path, &options, "").unwrap();
    let first = of(&path);
    fs::create_dir(folder.path().join("moved")).unwrap();
    fs::copy(&path, folder.path().join("moved/ct.nii.gz")).unwrap();
    assert_eq!(of(&folder.path().join("moved/ct.nii.gz")).hash(), first.hash());
    assert_ne!(Key::of_file(&path, &options, "resampled").unwrap().hash(), first.hash());
    let other = ReadOptions { label: Some(volume_io::Label::Value(1)), ..ReadOptions::default() };
    assert_ne!(Key::of_file(&path, &other, "").unwrap().hash(), first.hash());
    // Same length and time, different content.
    let time = fs::metadata(&path).unwrap().modified().unwrap();
    assert!(first.is_current());
    fs::remove_file(&path).unwrap();
    write(&path, 2);
    File::options().write(true).open(&path).unwrap().set_modified(time).unwrap();
    assert!(!first.is_current(), "changed since it was hashed: what was read then is not kept");
    assert_ne!(of(&path).hash(), first.hash());
    assert!(Key::of_file(&folder.path().join("none.nii.gz"), &options, "").is_none());
}
