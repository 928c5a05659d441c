//! Keys that change nothing.
#![allow(clippy::unwrap_used, reason = "a test fails by it")]

use std::path::Path;

use scene::{Scene, keys_without_effect};

fn keys(volume: &str, arm: &str) -> Vec<&'static str> {
    let text = format!(
        "name = \"a\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[volume]\n{volume}\n[arm]\n{arm}\n\
         [tool]\nburr_start_mm = [0.0, 0.0, 0.0]\ndirection = [1.0, 0.0, 0.0]\nbend_toward = [0.0, 0.0, 1.0]\n"
    );
    let scene = Scene::parse(&text, Path::new("a.toml")).unwrap();
    keys_without_effect(&scene).map(|(key, _)| key).collect()
}

#[test]
fn keys_of_dicom_folders_blocks_and_holders_are_named_elsewhere() {
    for (volume, said) in [
        ("path = \"ct.nrrd\"\nseries = \"1.2.3\"", &["volume.series"][..]),
        ("path = \"ct.nii.gz\"\nresample = \"rectify\"", &["volume.resample"]),
        ("path = \"ct\"\nseries = \"1.2.3\"\nresample = \"rectify\"", &[]),
        ("phantom = \"femur\"\nblock_density_ratio = 2.0", &["volume.block_density_ratio"]),
        ("phantom = \"block\"\nblock_density_ratio = 2.0", &[]),
    ] {
        assert_eq!(keys(volume, ""), said, "{volume}");
    }
    let block = "phantom = \"block\"";
    assert_eq!(
        keys(block, "holder_length_mm = 30.0\nholder_diameter_mm = 20.0"),
        ["arm.holder_length_mm", "arm.holder_diameter_mm"]
    );
    assert!(keys(block, "holder_length_mm = 30.0\ntool_position_mm = [0.0, 0.0, 100.0]").is_empty());
}
