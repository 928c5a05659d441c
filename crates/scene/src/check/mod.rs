//! Checks how a scene's keys relate to each other. Ranges of single keys: [`ranges`].

mod arm;
mod controllers;
mod recording;
mod sensors;
mod tool;

use std::path::Path;

use markups::vector::{cross, length, minus};

use crate::declaration::{Range, SCENE};
use crate::error::SceneError;
use crate::model::{
    Body, BuiltInStructure, CArm, CutterShape, DrillingLaw, Drr, DrrObject, FARTHEST_MM, ManipulatorRung,
    ObjectCylinder, Scene, Structure, StructureAction, StructureRole, Tool, Volume,
};
use crate::ranges;

pub(crate) use tool::tool;

/// Builds the errors of one scene file.
pub(crate) struct Checker<'a> {
    pub(crate) file: &'a Path,
}

impl Checker<'_> {
    pub(crate) fn range(&self, key: &str, value: f64, allowed: Range) -> Result<(), SceneError> {
        if allowed.allows(value) {
            return Ok(());
        }
        Err(SceneError::OutOfRange {
            file: self.file.to_owned(),
            key: key.to_owned(),
            value,
            lowest: allowed.lowest,
            highest: allowed.highest,
        })
    }

    /// Checks against the declared range, its lower end raised by another key.
    fn at_least(&self, key: &str, value: f64, lowest: f64) -> Result<(), SceneError> {
        let declared = self.declared(key)?;
        self.range(key, value, Range { lowest: declared.lowest.max(lowest), ..declared })
    }

    /// Checks against the declared range, its upper end lowered by another key.
    fn at_most(&self, key: &str, value: f64, highest: f64) -> Result<(), SceneError> {
        let declared = self.declared(key)?;
        self.range(key, value, Range { highest: declared.highest.min(highest), ..declared })
    }

    fn declared(&self, key: &str) -> Result<Range, SceneError> {
        let range = SCENE.kind(key).and_then(|kind| kind.range());
        range.ok_or_else(|| self.invalid(key, "has no declared range"))
    }

    pub(crate) fn invalid(&self, key: &str, problem: impl Into<String>) -> SceneError {
        SceneError::Invalid { file: self.file.to_owned(), key: key.to_owned(), problem: problem.into() }
    }

    /// Refuses a name that an earlier table has.
    fn distinct<'n>(
        &self,
        key: &str,
        name: &str,
        mut earlier: impl Iterator<Item = &'n String>,
    ) -> Result<(), SceneError> {
        match earlier.any(|other| other == name) {
            true => Err(self.invalid(key, format!("has a duplicate: `{name}`"))),
            false => Ok(()),
        }
    }
}

/// Checks a scene: first every value against its range, in declaration order, then how the keys relate.
pub(crate) fn check(scene: &Scene, given: &toml::Table, file: &Path) -> Result<(), SceneError> {
    let checker = Checker { file };
    ranges::check(&SCENE, given, "", &checker)?;
    check_relations(scene, &checker)?;
    if scene.truth.is_none() {
        return Ok(());
    }
    if scene.has_registration_error() && scene.volume.is_none() {
        return Err(
            checker.invalid("truth.registration_error_mm", "needs a `[volume]`: the misregistered bone")
        );
    }
    // The true world must be consistent, too; any error found only here is reported under `[truth]`.
    check_relations(&scene.as_it_is(), &checker).map_err(|error| error.below("truth"))
}

fn check_relations(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    match &scene.volume {
        Some(volume) => check_volume(volume, checker)?,
        None if !scene.predrill.is_empty() => {
            return Err(checker.invalid("predrill", "needs a `[volume]` to drill into"));
        }
        None => {}
    }
    check_bodies(scene, checker)?;
    check_structures(scene, checker)?;
    check_tool(&scene.tool, checker)?;
    tool::beside(scene, checker)?;
    check_tendons(scene, checker)?;
    if scene.drilling.edge_force_n_per_mm.is_some() && scene.drilling.edge_pressure_mpa.is_some() {
        let problem = "and `drilling.edge_pressure_mpa` are mutually exclusive; set only one";
        return Err(checker.invalid("drilling.edge_force_n_per_mm", problem));
    }
    let shape = scene.manipulator.tool.as_ref().map(|tool| tool.burr.shape());
    if scene.drilling.law == Some(DrillingLaw::TwistDrill) && shape != Some(CutterShape::Bit) {
        let problem = "is `twist_drill`, which needs a tool whose `burr.shape` is `bit`";
        return Err(checker.invalid("drilling.law", problem));
    }
    arm::check(&scene.arm, checker)?;
    if let Some(drr) = &scene.drr {
        check_drr(drr, checker)?;
        if scene.volume.is_none() {
            return Err(checker.invalid("drr", "needs a `[volume]` to image"));
        }
    }
    controllers::check(scene, checker)?;
    recording::check(scene, checker)?;
    sensors::check(scene, checker)
}

fn check_volume(volume: &Volume, checker: &Checker) -> Result<(), SceneError> {
    match (&volume.phantom, &volume.path) {
        (Some(_), Some(_)) => {
            return Err(checker.invalid(
                "volume",
                "has both `phantom` and `path`, which are mutually exclusive; set only one",
            ));
        }
        (None, None) => {
            return Err(checker.invalid("volume", "has neither `phantom` nor `path`; set one"));
        }
        _ => {}
    }
    if volume.mask && volume.path.is_none() {
        return Err(checker.invalid("volume.mask", "applies only to a file; a phantom is not a mask"));
    }
    if volume.resample_mm.is_some() && volume.path.is_none() {
        return Err(
            checker.invalid("volume.resample_mm", "applies only to a file; for a phantom set `spacing_mm`")
        );
    }
    check_choices(volume, checker)
}

/// Checks the keys that select part of a file.
fn check_choices(volume: &Volume, checker: &Checker) -> Result<(), SceneError> {
    let chosen = [
        ("volume.series", volume.series.is_some()),
        ("volume.resample", volume.resample.is_some()),
        ("volume.label", volume.label.is_some()),
        ("volume.slope", volume.slope != 1.0),
        ("volume.intercept", volume.intercept != 0.0),
    ];
    if let Some((key, _)) = chosen.iter().find(|(_, given)| *given && volume.path.is_none()) {
        return Err(checker.invalid(key, "applies only to a file, not to a phantom"));
    }
    if volume.label.is_some() && !volume.mask {
        return Err(checker.invalid("volume.label", "applies only to a mask; set `volume.mask = true`"));
    }
    if volume.slope == 0.0 {
        return Err(checker.invalid("volume.slope", "is 0, expected -1e6 to 1e6 without 0"));
    }
    if volume.mask && (volume.slope, volume.intercept) != (1.0, 0.0) {
        return Err(checker.invalid(
            "volume.mask",
            "and `volume.slope`, `volume.intercept` are mutually exclusive: a mask has no grey values",
        ));
    }
    Ok(())
}

fn check_bodies(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    for (index, body) in scene.body.iter().enumerate() {
        checker.distinct("body.name", &body.name, scene.body[..index].iter().map(|it| &it.name))?;
        check_shape(body, checker)?;
    }
    Ok(())
}

fn check_structures(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    for (index, structure) in scene.structure.iter().enumerate() {
        let Structure { name, ball, cuboid, tube, label, mesh, built_in, thickness_mm, .. } = structure;
        checker.distinct("structure.name", name, scene.structure[..index].iter().map(|it| &it.name))?;
        let shapes = [
            ball.is_some(),
            cuboid.is_some(),
            tube.is_some(),
            label.is_some(),
            mesh.is_some(),
            built_in.is_some(),
        ];
        let key = format!("structure `{name}`");
        if shapes.iter().filter(|shape| **shape).count() != 1 {
            let problem =
                "needs exactly one of `ball`, `cuboid`, `tube`, `curve`, `label`, `mesh`, `built_in`";
            return Err(checker.invalid(&key, problem));
        }
        if built_in.is_some() && scene.volume.is_none() {
            return Err(checker.invalid(&key, "needs a `[volume]`, whose bone it is defined by"));
        }
        if (*built_in == Some(BuiltInStructure::Cortex)) != thickness_mm.is_some() {
            let problem = "needs `thickness_mm` and `built_in = \"cortex\"` together, or neither";
            return Err(checker.invalid(&key, problem));
        }
        let is_fixture = [structure.on_margin, structure.on_breach].contains(&StructureAction::Fixture);
        if is_fixture && scene.manipulator.outer_tube().is_some() {
            return Err(checker.invalid(&key, "has a `fixture`, which does not hold back an outer tube"));
        }
        let has_action =
            structure.on_margin != StructureAction::Event || structure.on_breach != StructureAction::Event;
        if structure.role == StructureRole::Target && (has_action || built_in.is_some()) {
            let problem = "is a `target`: remove `on_margin`, `on_breach` and `built_in`";
            return Err(checker.invalid(&key, problem));
        }
        let mut coordinates = tube.iter().flat_map(|tube| tube.points_mm.iter().flatten());
        if let Some(far_mm) = coordinates.find(|mm| mm.is_nan() || mm.abs() > FARTHEST_MM) {
            let range = Range { lowest: -FARTHEST_MM, highest: FARTHEST_MM, or_zero: false };
            return checker.range("structure.tube.points_mm", *far_mm, range);
        }
    }
    scene.check_structure_content().map_err(|(key, problem)| checker.invalid(&key, problem))
}

fn check_shape(body: &Body, checker: &Checker) -> Result<(), SceneError> {
    let shapes = [body.cuboid.is_some(), body.ball.is_some(), body.capsule.is_some()];
    if shapes.iter().filter(|shape| **shape).count() != 1 {
        let problem = "needs exactly one of `cuboid`, `ball`, `capsule`";
        return Err(checker.invalid(&format!("body `{}`", body.name), problem));
    }
    Ok(())
}

fn check_tool(tool: &Tool, checker: &Checker) -> Result<(), SceneError> {
    for (key, vector) in [("tool.direction", tool.direction), ("tool.bend_toward", tool.bend_toward)] {
        checker.range(key, length(vector), Range { lowest: 1e-6, highest: 1e6, or_zero: false })?;
    }
    let [a, b] = [tool.direction, tool.bend_toward];
    if length(cross(a, b)) < 1e-3 * length(a) * length(b) {
        return Err(checker
            .invalid("tool.bend_toward", "is parallel to `tool.direction`; expected another direction"));
    }
    Ok(())
}

fn check_tendons(scene: &Scene, checker: &Checker) -> Result<(), SceneError> {
    // A tolerance leaves the model to be chosen to fit the tendons.
    let model = scene.manipulator.model;
    let flat = match model {
        None => !scene.tolerance.as_ref().is_some_and(|t| t.tip_mm.is_some() || t.path_mm.is_some()),
        Some(model) => !matches!(model, ManipulatorRung::Spatial | ManipulatorRung::Full),
    };
    let tool = scene.manipulator.tool.iter().flat_map(|tool| &tool.tendon);
    let across = scene.tendon.iter().map(|tendon| ("tendon.across_mm", tendon.across_mm));
    let across = across.chain(tool.clone().map(|it| ("manipulator.tool.tendon.across_mm", it.across_mm)));
    let twist = scene.tendon.iter().map(|tendon| ("tendon.twist_deg_per_mm", tendon.twist_deg_per_mm));
    let twist = twist.chain(tool.map(|it| ("manipulator.tool.tendon.twist_deg_per_mm", it.twist_deg_per_mm)));
    let twist = twist.map(|(key, twist)| (key, twist.unwrap_or(0.0)));
    if let Some((key, _)) = across.chain(twist).find(|(_, value)| flat && *value != 0.0) {
        let problem = "bends the tool out of the plane; set `manipulator.model` to spatial or full";
        return Err(checker.invalid(key, problem));
    }
    Ok(())
}

fn check_drr(drr: &Drr, checker: &Checker) -> Result<(), SceneError> {
    checker.at_least("drr.source_detector_mm", drr.source_detector_mm, drr.source_isocentre_mm)?;
    if drr.photons_per_pixel > 0.0 {
        checker.at_least("drr.photons_per_pixel", drr.photons_per_pixel, 1.0)?;
        let passed = drr.photons_per_pixel * drr.grid.map_or(1.0, |grid| grid.primary_transmission);
        if passed < 1.0 {
            let problem = format!("times `drr.grid.primary_transmission` is {passed}; expected at least 1");
            return Err(checker.invalid("drr.photons_per_pixel", problem));
        }
    }
    for (index, object) in drr.object.iter().enumerate() {
        checker.distinct("drr.object.name", &object.name, drr.object[..index].iter().map(|it| &it.name))?;
        check_object(object, checker)?;
    }
    let mut markers: Vec<String> = drr.object.iter().flat_map(DrrObject::marker_names).collect();
    markers.sort_unstable();
    if let Some(pair) = markers.windows(2).find(|pair| pair[0] == pair[1]) {
        let problem = format!("gives two balls the name `{}`; rename an object", pair[0]);
        return Err(checker.invalid("drr.object.name", problem));
    }
    drr.carm.as_ref().map_or(Ok(()), |carm| check_c_arm(carm, checker))
}

/// Least length of a cylinder: shorter ones have no axis once they are placed far away.
const LEAST_LENGTH_MM: f64 = 1e-3;

fn check_object(object: &DrrObject, checker: &Checker) -> Result<(), SceneError> {
    let DrrObject { name, balls, cylinder, cuboid, mesh, .. } = object;
    let key = format!("drr.object `{name}`");
    let shapes = [balls.is_some(), cylinder.is_some(), cuboid.is_some(), mesh.is_some()];
    if shapes.iter().filter(|shape| **shape).count() != 1 {
        return Err(checker.invalid(&key, "needs exactly one of `balls`, `cylinder`, `cuboid`, `mesh`"));
    }
    let far = |centre_mm: &&[f64; 3]| centre_mm.iter().any(|mm| mm.is_nan() || mm.abs() > FARTHEST_MM);
    if let Some(centre_mm) = balls.iter().flat_map(|balls| &balls.centres_mm).find(far) {
        let problem = format!("is {centre_mm:?}; each coordinate must be within {FARTHEST_MM} mm");
        return Err(checker.invalid(&format!("{key}.balls.centres_mm"), problem));
    }
    if let Some(ObjectCylinder { start_mm, end_mm, radius_mm, inner_radius_mm }) = cylinder {
        let length_mm = length(minus(*end_mm, *start_mm));
        if length_mm < LEAST_LENGTH_MM {
            let problem = format!("is {length_mm} mm long; expected at least {LEAST_LENGTH_MM}");
            return Err(checker.invalid(&format!("{key}.cylinder"), problem));
        }
        if inner_radius_mm >= radius_mm {
            let problem = format!("is {inner_radius_mm}; expected less than `radius_mm`, {radius_mm}");
            return Err(checker.invalid(&format!("{key}.cylinder.inner_radius_mm"), problem));
        }
    }
    Ok(())
}

/// Requires exactly one of the two forms, complete. The values are checked when the C-arm is built.
fn check_c_arm(carm: &CArm, checker: &Checker) -> Result<(), SceneError> {
    let camera = [carm.intrinsics.is_some(), carm.rotation.is_some(), carm.translation_mm.is_some()];
    let points = [
        carm.source_mm.is_some(),
        carm.detector_centre_mm.is_some(),
        carm.row_axis.is_some(),
        carm.column_axis.is_some(),
    ];
    let (any, all) = (|keys: &[bool]| keys.contains(&true), |keys: &[bool]| !keys.contains(&false));
    let as_camera = all(&camera) && !any(&points);
    let as_points = all(&points) && !any(&camera) && carm.pixel_centre.is_none();
    if as_camera || as_points {
        return Ok(());
    }
    let problem = "does not define one C-arm; expected either `intrinsics`, `rotation`, `translation_mm` \
                   (and `pixel_centre`), or \
                   `source_mm`, `detector_centre_mm`, `row_axis`, `column_axis`";
    Err(checker.invalid("drr.carm", problem))
}
