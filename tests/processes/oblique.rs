//! CTs whose axes are not quite perpendicular, or whose grid no volume may have.

use std::fs;

use crate::common::program::{Place, trabecula};
use crate::common::scenes;

/// A block of bone, 24 x 24 x 24 voxels of 1 mm, with these lines in its header.
fn write_ct(place: &Place, geometry: &str) {
    let header = format!(
        "NRRD0004\ntype: short\ndimension: 3\nsizes: 24 24 24\nspace: left-posterior-superior\nendian: little\nencoding: raw\n{geometry}\n\n"
    );
    let mut bytes = header.into_bytes();
    bytes.extend(300_i16.to_le_bytes().repeat(24 * 24 * 24));
    fs::write(place.path("ct.nrrd"), bytes).unwrap();
}

/// Returns whether the commands that read a CT accept it; they must agree.
fn all_take_it(geometry: &str) -> bool {
    let place = Place::new();
    write_ct(&place, geometry);
    let scene = place.scene(&scenes::drill_in_file("lockstep", 0.005, "ct.nrrd"));
    let (ct, picture, out) = (place.path("ct.nrrd"), place.path("x.png"), place.path("out"));
    let said = [
        ("volume info", trabecula(&[&"volume", &"info", &ct])),
        ("scene check", trabecula(&[&"scene", &"check", &scene])),
        ("drr", trabecula(&[&"drr", &ct, &"-o", &picture])),
        ("run", trabecula(&[&"run", &scene, &"--output", &out, &"--quiet"])),
    ];
    for (command, done) in &said {
        assert!(matches!(done.code, Some(0 | 2)), "{command} of {geometry}: {:?} {}", done.code, done.err);
        assert_eq!(done.code, said[0].1.code, "{command} of {geometry}: {}", done.err);
        if done.code == Some(2) {
            assert!(done.err.contains("ct.nrrd") && done.err.contains("expected"), "{command}: {}", done.err);
            assert_eq!(done.err.matches("trabecula: ").count(), 1, "{command}: {}", done.err);
        }
    }
    let is_taken = said[0].1.code == Some(0);
    let expected: &[&str] =
        if is_taken { &["ct.nrrd", "out", "scene.toml", "x.png"] } else { &["ct.nrrd", "scene.toml"] };
    assert_eq!(place.entries(), expected, "{geometry}");
    is_taken
}

/// Regression: from 1e-5 to 1e-4 `volume info`, `scene check` and `drr` accepted it, and `run` died once its
/// folder and its parts existed.
#[test]
fn a_ct_is_taken_or_refused_by_every_command_alike_however_far_its_axes_are_off() {
    for (cosine, taken) in [(1e-6, true), (2e-5, true), (9.9e-5, true), (1.01e-4, false), (1e-2, false)] {
        let directions = format!("(1,0,0) ({cosine:e},1,0) (0,0,1)");
        let geometry = format!("space directions: {directions}\nspace origin: (-11.5,-11.5,-11.5)");
        assert_eq!(all_take_it(&geometry), taken, "{cosine:e}");
    }
}

/// Regression: the same with voxels of 0.2 m or 0.5 µm, and with a CT 200 m away: the X-ray rejected what the
/// readers accepted.
#[test]
fn a_ct_of_absurd_voxels_or_far_away_is_refused_by_every_command_alike() {
    let directions = |mm: f64| format!("({mm:?},0,0) (0,{mm:?},0) (0,0,{mm:?})");
    for (spacing_mm, origin_mm, taken) in
        [(1.0, -11.5, true), (200.0, -11.5, false), (0.0005, 0.0, false), (1.0, 200_000.0, false)]
    {
        let geometry = format!(
            "space directions: {}\nspace origin: ({origin_mm:?},{origin_mm:?},{origin_mm:?})",
            directions(spacing_mm)
        );
        assert_eq!(all_take_it(&geometry), taken, "{geometry}");
    }
}
