//! Keys of a valid scene that have no effect, because another key overrides them.

use crate::model::{
    Arm, ArmModel, Drr, Phantom, Scatter, ScatterModel, Scene, TendonCable, ToolDescription, Tracker, Volume,
};

/// A key set to a value other than its default, and why it has no effect.
pub type NoEffect = (&'static str, &'static str);

/// Keys set to non-default values without effect.
pub fn keys_without_effect(scene: &Scene) -> impl Iterator<Item = NoEffect> {
    let trackers = scene.sensor.iter().filter_map(|sensor| sensor.tracker.as_ref());
    let has_encoders = scene.sensor.iter().any(|sensor| sensor.encoders.is_some());
    let of_scene = vain(
        scene.drr.is_none(),
        "without `[drr]`",
        [
            ("arm.xray_density_g_per_cm3", scene.arm.xray_density_g_per_cm3.is_some()),
            ("body.material", scene.body.iter().any(|body| body.material.is_some())),
        ],
    )
    .chain(vain(
        matches!(scene.arm.model, Some(ArmModel::Gantry | ArmModel::Fixed)),
        "on an arm without revolute joints: its readings are empty",
        [("sensor.encoders", has_encoders)],
    ));
    let of_volume = scene.volume.iter().flat_map(of_volume);
    let of_tool = scene.manipulator.tool.iter().flat_map(of_tool);
    let of_drr = scene.drr.iter().flat_map(of_drr);
    let of_parts = of_volume.chain(of_tool).chain(of_arm(&scene.arm)).chain(of_drr);
    of_parts.chain(trackers.flat_map(of_tracker)).chain(of_scene)
}

/// Returns those of the keys that are set, if they have no effect.
fn vain<const N: usize>(
    they_are: bool,
    why: &'static str,
    keys: [(&'static str, bool); N],
) -> impl Iterator<Item = NoEffect> {
    keys.into_iter().filter(move |(_, is_given)| they_are && *is_given).map(move |(key, _)| (key, why))
}

fn of_volume(volume: &Volume) -> impl Iterator<Item = NoEffect> {
    let ratio = Volume::default_block_density_ratio();
    vain(
        volume.path.is_some(),
        "together with `volume.path`: it applies to a phantom",
        [
            ("volume.spacing_mm", volume.spacing_mm != Volume::default_spacing_mm()),
            ("volume.block_density_ratio", volume.block_density_ratio != ratio),
        ],
    )
    .chain(vain(
        volume.phantom == Some(Phantom::Femur),
        "for the femur: it applies to the phantom `block`",
        [("volume.block_density_ratio", volume.block_density_ratio != ratio)],
    ))
}

fn of_tool(tool: &ToolDescription) -> impl Iterator<Item = NoEffect> {
    let is_given = tool.tendon_cable != TendonCable::default();
    vain(tool.tendon.is_empty(), "on a tool without tendons", [("manipulator.tool.tendon_cable", is_given)])
}

fn of_arm(arm: &Arm) -> impl Iterator<Item = NoEffect> {
    let differs = |of: fn(&Arm) -> f64| of(arm) != of(&Arm::default());
    let [x, y, z] = arm.tool_position_mm.map(|mm| mm * 1e-3);
    vain(
        arm.holder().reach_m((x * x + y * y + z * z).sqrt()).is_none(),
        "without `arm.tool_position_mm`: the tool's base is on the flange, so there is no holder",
        [
            ("arm.holder_length_mm", arm.holder_length_mm.is_some()),
            ("arm.holder_diameter_mm", arm.holder_diameter_mm.is_some()),
        ],
    )
    .chain(vain(
        arm.model == Some(ArmModel::Fixed),
        "on a fixed arm",
        [
            ("arm.max_speed_mm_per_s", differs(|arm| arm.max_speed_mm_per_s)),
            ("arm.max_acceleration_mm_per_s2", differs(|arm| arm.max_acceleration_mm_per_s2)),
            ("arm.max_jerk_mm_per_s3", differs(|arm| arm.max_jerk_mm_per_s3)),
        ],
    ))
}

fn of_drr(drr: &Drr) -> impl Iterator<Item = NoEffect> {
    let (isocentre_mm, detector_mm) = (Drr::default_source_isocentre_mm(), Drr::default_source_detector_mm());
    let by_c_arm = vain(
        drr.carm.is_some(),
        "together with `[drr.carm]`",
        [
            ("drr.primary_angle_deg", drr.primary_angle_deg != 0.0),
            ("drr.secondary_angle_deg", drr.secondary_angle_deg != 0.0),
            ("drr.source_isocentre_mm", drr.source_isocentre_mm != isocentre_mm),
            ("drr.source_detector_mm", drr.source_detector_mm != detector_mm),
        ],
    );
    let energy = [("drr.energy_kev", drr.energy_kev != Drr::default_energy_kev())];
    let other_model = |scatter: Scatter| scatter.model != ScatterModel::MonteCarlo;
    let changed = |scatter: Scatter| scatter.photons != Scatter::default_photons();
    let photons = [("drr.scatter.photons", drr.scatter.is_some_and(changed))];
    let grid = [("drr.grid", drr.grid.is_some())];
    let has_scatter = drr.scatter.is_some_and(|scatter| scatter.model != ScatterModel::None);
    let by_c_arm = by_c_arm.chain(vain(
        !has_scatter && drr.photons_per_pixel == 0.0,
        "without `[drr.scatter]` and without noise",
        grid,
    ));
    by_c_arm.chain(vain(drr.spectrum.is_some(), "together with `[drr.spectrum]`", energy)).chain(vain(
        drr.scatter.is_some_and(other_model),
        "without `model = \"monte_carlo\"`",
        photons,
    ))
}

fn of_tracker(tracker: &Tracker) -> impl Iterator<Item = NoEffect> {
    vain(
        tracker.camera_mm.is_none(),
        "without `camera_mm`: an electromagnetic tracker needs no line of sight",
        [
            ("sensor.tracker.view_deg", tracker.view_deg != Tracker::default_view_deg()),
            ("sensor.tracker.marker_faces", tracker.marker_faces != Tracker::default_marker_faces()),
        ],
    )
}
