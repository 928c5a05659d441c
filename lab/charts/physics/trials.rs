//! The scenes on which a plan's path errors are measured: pulls in free space, tunnels in bone.

use std::path::Path;

use ipc_types::scene::Scene;
use simulation::CtView;

use super::against::{Compared, References, against_reference, distance_mm, path};
use crate::reproduce::rig::Block;
use trabecula::failure::Failure;
use trabecula::plan::{GENTLE_N, Pull, RAMPED_N, Settings};

/// Voxel of the tunnels, mm.
const VOXEL_MM: f64 = 0.5;
/// Duration of a pull, s.
const PULL_S: f64 = 0.8;
/// Where the voxels of a tunnel lie, in voxels from the first place.
const PLACES: [[f64; 3]; 6] =
    [[0.0; 3], [0.5, 0.0, 0.0], [0.0, 0.0, 0.5], [0.25, 0.25, 0.25], [0.5, 0.5, 0.5], [0.25, 0.0, 0.75]];

/// A controller, and what the scene changes of the tool.
pub struct Trial {
    /// The table of the controller, with its parameters.
    pub controller: String,
    /// Lines of `[manipulator]`.
    pub tool: String,
    /// Duration, s.
    pub seconds: f64,
}

impl Trial {
    /// Holds a tension from the first tick on.
    pub fn hold(tension_n: f64, tendon_friction: f64) -> Trial {
        Trial {
            controller: format!("[controller.hold]\ntension_n = {tension_n:?}\n"),
            tool: format!("tendon_friction = {tendon_friction:?}\n"),
            seconds: PULL_S,
        }
    }

    /// Pulls in steps up and down again.
    pub fn sweep(most_n: f64, step_n: f64, tendon_friction: f64) -> Trial {
        let controller =
            format!("[controller.tension_sweep]\nmost_n = {most_n:?}\nstep_n = {step_n:?}\nsettle_s = 0.1\n");
        Trial { controller, ..Trial::hold(0.0, tendon_friction) }
    }

    /// Feeds and pulls on a ramp over the first half of the way.
    pub fn feed(tension_n: f64, feed_mm_per_s: f64, insertion_mm: f64) -> Trial {
        let ramp_mm = 0.5 * insertion_mm;
        let controller = format!(
            "[controller.curved_drilling]\nfeed_mm_per_s = {feed_mm_per_s:?}\ninsertion_mm = {insertion_mm:?}\n\
             tension_n = {tension_n:?}\nramp_end_mm = {ramp_mm:?}\nburr_speed_rpm = 2250.0\nfeedback = \"none\"\n"
        );
        Trial { controller, tool: String::new(), seconds: insertion_mm / feed_mm_per_s + 0.5 }
    }

    /// The scene, in free space or in bone.
    ///
    /// # Errors
    /// A parameter is out of range.
    pub fn scene(&self, tolerance: &str, bone: Option<&Block>) -> Result<(Scene, String), Failure> {
        let volume = if bone.is_some() {
            "[volume]\nphantom = \"block\"\nbone_threshold_hu = -100\n[[predrill]]\nfrom_mm = [0.0, 0.0, -60.0]\n\
             to_mm = [0.0, 0.0, 0.0]\ndiameter_mm = 7.0\n"
        } else {
            ""
        };
        let text = format!(
            "name = \"trial\"\n{tolerance}[run]\nmode = \"lockstep\"\nduration_s = {:?}\n{volume}[manipulator]\n{}\
             [tool]\nburr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, 0.0]\n\
             [[controller]]\nname = \"driver\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\n{}",
            self.seconds, self.tool, self.controller
        );
        let scene = Scene::parse(&text, Path::new("trial.toml"));
        Ok((scene.map_err(|cause| Failure::failed(cause.to_string()))?, text))
    }
}

/// A block whose density rises along and across the tunnel, 200 to 440 kg/m³; its voxels are shifted by `place`, in voxels.
pub fn block(place: [f64; 3]) -> Block {
    let shifted = |corner: [f64; 3]| [0, 1, 2].map(|a| corner[a] + place[a] * VOXEL_MM);
    Block::new(shifted([-10.0, -8.0, -38.0]), shifted([34.0, 8.0, 36.0]), VOXEL_MM, |p| {
        300.0 + 3000.0 * p.x + 1000.0 * p.z
    })
}

/// The pulls in free space.
fn pulls(pull: Pull) -> Vec<Trial> {
    match pull {
        Pull::Gentle => vec![
            Trial::hold(3.0, 0.0),
            Trial::hold(GENTLE_N, 0.0),
            Trial::hold(GENTLE_N, 0.3),
            Trial::sweep(GENTLE_N, 2.0, 0.1),
            Trial::feed(RAMPED_N, 20.0, 10.0),
        ],
        Pull::Hard => vec![
            Trial::hold(10.0, 0.0),
            Trial::hold(15.0, 0.3),
            Trial::hold(20.0, 0.0),
            Trial::hold(60.0, 0.0),
            Trial::sweep(60.0, 20.0, 0.3),
        ],
    }
}

/// The tunnels in bone.
fn tunnels() -> [Trial; 3] {
    [Trial::feed(4.0, 4.0, 20.0), Trial::feed(10.0, 5.0, 20.0), Trial::feed(15.0, 5.0, 20.0)]
}

/// The larger; NaN wins.
fn larger(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() { f64::NAN } else { a.max(b) }
}

fn with(settings: &Settings, trial: &Trial, bone: Option<&Block>) -> Result<Scene, Failure> {
    let (mut scene, _) = trial.scene("", bone)?;
    settings.write_into(&mut scene);
    Ok(scene)
}

/// The worst path error and the worst error at the end of the pulls, and the median cost.
///
/// # Errors
/// The physics refuses the settings.
pub fn free(settings: &Settings, pull: Pull, references: &mut References) -> Result<Compared, Failure> {
    let mut worst = Compared { path_mm: 0.0, worst_path_mm: 0.0, end_mm: 0.0, us_per_ms: f64::INFINITY };
    for trial in pulls(pull) {
        let own = against_reference(&with(settings, &trial, None)?, None, references)?;
        worst.path_mm = larger(worst.path_mm, own.path_mm);
        worst.worst_path_mm = larger(worst.worst_path_mm, own.worst_path_mm);
        worst.end_mm = larger(worst.end_mm, own.end_mm);
        worst.us_per_ms = worst.us_per_ms.min(own.us_per_ms);
    }
    Ok(worst)
}

/// The references of the tunnels, for each place of the voxels.
#[derive(Default)]
pub struct TunnelReferences([References; PLACES.len()]);

/// The path error of the worst tunnel, r.m.s. over the places of the voxels, mm. One place alone says little: by chance it may hide the
/// error of one setting and add to that of another.
///
/// # Errors
/// The physics refuses the settings.
pub fn drilled_mm(settings: &Settings, references: &mut TunnelReferences) -> Result<f64, Failure> {
    let mut squares = tunnels().map(|_| 0.0);
    for (place, references) in PLACES.into_iter().zip(&mut references.0) {
        let block = block(place);
        let ct = CtView { geometry: block.geometry, hu: &block.hu };
        for (trial, squares) in tunnels().iter().zip(&mut squares) {
            let own = against_reference(&with(settings, trial, Some(&block))?, Some(ct), references)?;
            *squares += own.worst_path_mm * own.worst_path_mm;
        }
    }
    Ok(squares.into_iter().fold(0.0, |worst, squares| larger(worst, (squares / PLACES.len() as f64).sqrt())))
}

/// How far the path of a tunnel moves with the place of the voxels: the worst pair of places, r.m.s., mm.
///
/// # Errors
/// The physics refuses the settings.
pub fn grid_mm(settings: &Settings) -> Result<f64, Failure> {
    let mut worst = 0.0;
    for trial in tunnels() {
        let mut paths = Vec::new();
        for place in PLACES {
            let block = block(place);
            let ct = CtView { geometry: block.geometry, hu: &block.hu };
            paths.push(path(&with(settings, &trial, Some(&block))?, Some(ct))?.0);
        }
        for (i, one) in paths.iter().enumerate() {
            for other in &paths[..i] {
                worst = larger(worst, distance_mm(one, other));
            }
        }
    }
    Ok(worst)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::*;

    /// Regression: the feeds waited for X-ray frames that never came, and the tunnels stood still.
    #[test]
    fn a_feed_moves_the_burr() {
        let (scene, _) = Trial::feed(2.0, 20.0, 10.0).scene("", None).unwrap();
        let (path, _) = path(&scene, None).unwrap();
        assert!((path[path.len() - 1] - path[0]).norm() > 8e-3);
    }
}
