//! The measured error of a planar model, reported at the end of a run.

use std::fmt;

use ipc_types::scene::Scene;
use serde::{Deserialize, Serialize};
use simulation::manipulator::Rung;
use simulation::rung;

use super::TABLE;
use super::table::{OWN_LINKS, Row, Settings, read};

/// Measured deviation of a planar model from the reference while drilling.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ModelError {
    /// Name of the model.
    pub model: String,
    /// R.m.s. error of the worst drilled path: for exactly these settings, or the range over all measured
    /// settings with the same model and contact.
    pub path_mm: [f64; 2],
}

impl ModelError {
    /// The error for a scene with bone and a planar model, if it was measured.
    pub fn of(scene: &Scene) -> Option<ModelError> {
        ModelError::by(scene, &read(TABLE)?)
    }

    fn by(scene: &Scene, rows: &[Row]) -> Option<ModelError> {
        scene.volume.as_ref()?;
        let manipulator = &scene.manipulator;
        // Measured only with the standard tool.
        if manipulator.tool.is_some() {
            return None;
        }
        let settings = Settings {
            rung: rung(manipulator.model.unwrap_or_default()),
            links: manipulator.links.unwrap_or(OWN_LINKS),
            integrator: manipulator.integrator.unwrap_or_default(),
            dt_ms: scene.run.dt_ms,
            contact: scene.contact.voxels.unwrap_or_default(),
        };
        let is_alike = |row: &&Row| {
            row.settings.rung == settings.rung
                && row.settings.contact == settings.contact
                && row.drilled_path_mm.is_finite()
        };
        if !matches!(settings.rung, Rung::ConstantCurvature | Rung::Planar) {
            return None;
        }
        let alike: Vec<&Row> = rows.iter().filter(is_alike).collect();
        let same = alike.iter().find(|row| row.settings == settings);
        let errors = same.map_or_else(
            || alike.iter().map(|row| row.drilled_path_mm).collect(),
            |row| vec![row.drilled_path_mm],
        );
        let (least, most) =
            errors.iter().fold((f64::INFINITY, 0.0_f64), |(least, most), &mm| (least.min(mm), most.max(mm)));
        (!errors.is_empty())
            .then(|| ModelError { model: settings.rung.name().to_owned(), path_mm: [least, most] })
    }
}

impl fmt::Display for ModelError {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [least, most] = self.path_mm.map(|mm| format!("{mm:.2}"));
        let range = if least == most { least } else { format!("{least} to {most}") };
        write!(
            out,
            "`{}` bends in one plane: up to {range} mm r.m.s. off `full` on the drilled paths measured",
            self.model
        )
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use std::path::Path;

    use ipc_types::scene::{ContactVoxels, Integrator, ManipulatorRung};

    use super::*;

    /// Regression: neither the end of a run nor the README said how far the default model is off.
    #[test]
    fn the_known_error_of_a_model_that_bends_in_one_plane_is_said() {
        use crate::scenes::BuiltIn;
        let femur = BuiltIn::Femur.scene().unwrap();
        let known = |change: &dyn Fn(&mut Scene)| {
            let mut scene = femur.clone();
            change(&mut scene);
            ModelError::of(&scene).map(|error| error.to_string())
        };
        let rows = read(TABLE).unwrap();
        let drilled_mm = |rung| {
            let of_rung = rows.iter().filter(move |row| {
                row.settings.rung == rung && row.settings.contact == ContactVoxels::Planes
            });
            of_rung.map(|row| row.drilled_path_mm).filter(|mm| mm.is_finite())
        };
        let standard = Settings {
            rung: Rung::Planar,
            links: 27,
            integrator: Integrator::Hybrid,
            dt_ms: 1.0,
            contact: ContactVoxels::Planes,
        };
        let standard = rows.iter().find(|row| row.settings == standard).unwrap().drilled_path_mm;
        // The scene names no integrator, so the figure must be that of the default integrator only.
        assert_eq!(ModelError::of(&femur).unwrap().path_mm, [standard; 2]);
        let figure = format!("{standard:.2} mm r.m.s.");
        let said = known(&|_| {}).unwrap();
        assert!(said.starts_with("`planar` bends in one plane: ") && said.contains(&figure), "{said}");
        for page in [include_str!("../../../../README.md"), include_str!("../../../../docs/accuracy-plan.md")]
        {
            assert!(page.contains(&figure), "a page does not say {figure}");
        }
        // This step was not measured: the range over those that were.
        let (least, most) = (
            drilled_mm(Rung::Planar).fold(f64::INFINITY, f64::min),
            drilled_mm(Rung::Planar).fold(0.0, f64::max),
        );
        let range = format!("{least:.2} to {most:.2} mm");
        let other = known(&|scene| scene.run.dt_ms = 0.7).unwrap();
        assert!(other.contains(&range), "{other}, expected {range}");
        let arc = known(&|scene| scene.manipulator.model = Some(ManipulatorRung::ConstantCurvature)).unwrap();
        let figure = format!("{:.2} mm", drilled_mm(Rung::ConstantCurvature).fold(0.0, f64::max));
        assert!(arc.contains(&figure), "{arc}, expected {figure}");
        assert_eq!(known(&|scene| scene.manipulator.model = Some(ManipulatorRung::Full)), None);
        assert_eq!(known(&|scene| scene.volume = None), None, "measured in bone only");
        let rod = include_str!("../../../../configs/tools/rigid_drill.toml");
        let rod = ipc_types::scene::ToolDescription::parse(rod, Path::new("rigid_drill.toml")).unwrap();
        assert_eq!(
            known(&|scene| scene.manipulator.tool = Some(rod.clone())),
            None,
            "of the standard tool only"
        );
    }
}
