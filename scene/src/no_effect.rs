//! Keys of a valid scene that change nothing, because another key stands in their place.

use crate::model::{Arm, ArmModel, Drr, Scene, Tracker, Volume};

/// A key with another value than its default, and why it changes nothing.
pub type NoEffect = (&'static str, &'static str);

/// Keys whose values, other than the defaults, have no effect.
pub fn keys_without_effect(scene: &Scene) -> impl Iterator<Item = NoEffect> {
    let of_volume = scene.volume.iter().flat_map(of_volume);
    let of_drr = scene.drr.iter().flat_map(of_drr);
    let trackers = scene.sensor.iter().filter_map(|sensor| sensor.tracker.as_ref());
    let of_scene = [
        (
            scene.drr.is_none() && scene.arm.xray_density_g_per_cm3.is_some(),
            "arm.xray_density_g_per_cm3",
            "without `[drr]`",
        ),
        (
            !turns(&scene.arm) && scene.sensor.iter().any(|sensor| sensor.encoders.is_some()),
            "sensor.encoders",
            "on an arm without joints that turn: its readings are empty",
        ),
    ];
    of_volume
        .chain(of_arm(&scene.arm))
        .chain(of_drr)
        .chain(trackers.flat_map(of_tracker))
        .chain(kept(of_scene))
}

fn turns(arm: &Arm) -> bool {
    !matches!(arm.model, Some(ArmModel::Gantry | ArmModel::Fixed))
}

fn kept<const N: usize>(keys: [(bool, &'static str, &'static str); N]) -> impl Iterator<Item = NoEffect> {
    keys.into_iter().filter_map(|(is_without, key, why)| is_without.then_some((key, why)))
}

fn of_volume(volume: &Volume) -> impl Iterator<Item = NoEffect> {
    let (is_file, phantom) = (volume.path.is_some(), "beside `volume.path`: it is for a phantom");
    kept([
        (is_file && volume.spacing_mm != Volume::default_spacing_mm(), "volume.spacing_mm", phantom),
        (
            is_file && volume.block_density_ratio != Volume::default_block_density_ratio(),
            "volume.block_density_ratio",
            phantom,
        ),
    ])
}

fn of_arm(arm: &Arm) -> impl Iterator<Item = NoEffect> {
    let (standard, is_fixed) = (Arm::default(), arm.model == Some(ArmModel::Fixed));
    let why = "on a fixed arm";
    kept([
        (is_fixed && arm.max_speed_mm_per_s != standard.max_speed_mm_per_s, "arm.max_speed_mm_per_s", why),
        (
            is_fixed && arm.max_acceleration_mm_per_s2 != standard.max_acceleration_mm_per_s2,
            "arm.max_acceleration_mm_per_s2",
            why,
        ),
        (is_fixed && arm.max_jerk_mm_per_s3 != standard.max_jerk_mm_per_s3, "arm.max_jerk_mm_per_s3", why),
    ])
}

fn of_drr(drr: &Drr) -> impl Iterator<Item = NoEffect> {
    let (by_carm, by_spectrum) = (drr.carm.is_some(), drr.spectrum.is_some());
    let carm = "beside `[drr.carm]`";
    kept([
        (by_carm && drr.primary_angle_deg != 0.0, "drr.primary_angle_deg", carm),
        (by_carm && drr.secondary_angle_deg != 0.0, "drr.secondary_angle_deg", carm),
        (
            by_carm && drr.source_isocentre_mm != Drr::default_source_isocentre_mm(),
            "drr.source_isocentre_mm",
            carm,
        ),
        (
            by_carm && drr.source_detector_mm != Drr::default_source_detector_mm(),
            "drr.source_detector_mm",
            carm,
        ),
        (
            by_spectrum && drr.energy_kev != Drr::default_energy_kev(),
            "drr.energy_kev",
            "beside `[drr.spectrum]`",
        ),
    ])
}

fn of_tracker(tracker: &Tracker) -> impl Iterator<Item = NoEffect> {
    let is_electromagnetic = tracker.camera_mm.is_none();
    let why = "without `camera_mm`: an electromagnetic tracker needs no line of sight";
    kept([
        (
            is_electromagnetic && tracker.view_deg != Tracker::default_view_deg(),
            "sensor.tracker.view_deg",
            why,
        ),
        (
            is_electromagnetic && tracker.marker_faces != Tracker::default_marker_faces(),
            "sensor.tracker.marker_faces",
            why,
        ),
    ])
}
