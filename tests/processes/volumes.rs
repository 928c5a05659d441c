//! What is chosen of a volume's file, and what is said of a volume that is valid and most likely a mistake.

use std::fs;

use crate::common::program::{Place, trabecula};
use crate::common::scenes;

/// 24 x 24 x 24 voxels of 1 mm whose first centre lies at `origin`; voxels take `inside` and `outside` in turn, slab by slab.
fn write_ct(place: &Place, name: &str, origin: &str, (inside, outside): (i16, i16), more: &str) {
    let header = format!(
        "NRRD0004\ntype: short\ndimension: 3\nsizes: 24 24 24\nspace: left-posterior-superior\nendian: little\nencoding: raw\n\
         space directions: (1,0,0) (0,1,0) (0,0,1)\nspace origin: {origin}\n{more}\n"
    );
    let slab = |k: usize| if k % 4 == 3 { outside } else { inside };
    let voxels = (0..24).flat_map(|k| slab(k).to_le_bytes().repeat(24 * 24));
    fs::write(place.path(name), header.into_bytes().into_iter().chain(voxels).collect::<Vec<u8>>()).unwrap();
}

fn check(place: &Place, volume: &str) -> (Option<i32>, String) {
    let text = scenes::drill_in_file("lockstep", 0.005, "ct.nrrd").replace("path = \"ct.nrrd\"", volume);
    let scene = place.scene(&text);
    let done = trabecula(&[&"scene", &"check", &scene]);
    (done.code, format!("{}{}", done.out, done.err))
}

/// A 0/1 mask was read as Hounsfield units without a word, and nothing was ever drilled.
#[test]
fn a_mask_that_is_not_called_one_is_named_by_every_command() {
    let place = Place::new();
    write_ct(&place, "ct.nrrd", "(-11.5,-11.5,-11.5)", (1, 0), "");
    let (code, said) = check(&place, "path = \"ct.nrrd\"");
    // As Hounsfield units it holds no bone.
    assert!(code == Some(2) && said.contains("every voxel is 0 or 1: this looks like a mask"), "{said}");
    let done = trabecula(&[&"drr", &place.path("ct.nrrd"), &"-o", &place.path("x.png")]);
    assert!(done.code == Some(0) && done.err.contains("this looks like a mask"), "{}", done.err);
    let (code, said) = check(&place, "path = \"ct.nrrd\"\nmask = true");
    assert!(code == Some(0) && !said.contains("mask"), "{said}");
}

/// A scene with the signs of RAS was valid, ran, and drilled no voxel.
#[test]
fn a_start_with_the_signs_of_another_program_is_named() {
    let place = Place::new();
    // The tool starts near the origin: this CT lies beside it, and around the mirrored point.
    write_ct(&place, "ct.nrrd", "(30,30,-40)", (300, 300), "");
    let start = |x: &str| {
        let text = scenes::drill_in_file("lockstep", 0.005, "ct.nrrd");
        let line = text.lines().find(|line| line.starts_with("burr_start_mm")).unwrap().to_owned();
        let scene = place.scene(&text.replace(&line, &format!("burr_start_mm = [{x}, {x}, -25.0]")));
        let done = trabecula(&[&"scene", &"check", &scene]);
        (done.code, format!("{}{}", done.out, done.err))
    };
    let (code, said) = start("-40.0");
    assert_eq!(code, Some(2), "the feed ends before the bone");
    assert!(said.contains("`tool.burr_start_mm` = [-40, -40, -25] lies outside of the volume"), "{said}");
    let (code, said) = start("40.0");
    assert!(code == Some(0) && !said.contains("outside of the volume"), "{said}");
}

#[test]
fn a_label_is_chosen_by_value_or_by_its_segments_name() {
    let place = Place::new();
    let names = "Segment0_Name:=femur\nSegment0_LabelValue:=5\nSegment0_Layer:=0\n";
    write_ct(&place, "ct.nrrd", "(-11.5,-11.5,-11.5)", (5, 0), names);
    for (label, code, word) in [
        ("5", Some(0), "is valid"),
        ("\"femur\"", Some(0), "is valid"),
        ("7", Some(2), "label 7"),
        ("\"tibia\"", Some(2), "\"femur\" (5)"),
    ] {
        let said = check(&place, &format!("path = \"ct.nrrd\"\nmask = true\nlabel = {label}"));
        assert!(said.0 == code && said.1.contains(word), "{label}: {said:?}");
    }
    let (code, said) = check(&place, "path = \"ct.nrrd\"\nlabel = 5");
    assert!(code == Some(2) && said.contains("expected `volume.mask = true`"), "{said}");
    let (code, said) = check(&place, "phantom = \"block\"\nresample = \"rectify\"");
    assert!(code == Some(2) && said.contains("`volume.resample` is for a file"), "{said}");
}

/// `1e300` was said in 301 digits.
#[test]
fn a_huge_number_is_said_in_few_digits() {
    let place = Place::new();
    let scene =
        place.scene(&scenes::drill("lockstep", 1.0).replace("duration_s = 1.0", "duration_s = 1e300"));
    let done = trabecula(&[&"scene", &"check", &scene]);
    assert_eq!(done.code, Some(2));
    assert!(done.err.contains("`run.duration_s` is 1e300, allowed is"), "{}", done.err);
}
