//! Trial scenes for measuring path errors: pulls in free space, tunnels in bone.

use std::path::Path;

use ipc_types::messages::MAX_TENDONS;
use ipc_types::scene::{Scene, TubeDeployment};

use super::block::Block;
use crate::failure::Failure;
use crate::plan::{GENTLE_N, Pull, RAMPED_N};

/// Voxel size of the tunnels, mm.
const VOXEL_MM: f64 = 0.5;
/// Speed of the burr.
const BURR_RPM: f64 = 2250.0;
/// Duration of a pull of the standard tool, s.
pub const PULL_S: f64 = 0.8;
/// Offsets of a tunnel's voxel grid, in voxels.
pub const PLACES: [[f64; 3]; 6] =
    [[0.0; 3], [0.5, 0.0, 0.0], [0.0, 0.0, 0.5], [0.25, 0.25, 0.25], [0.5, 0.5, 0.5], [0.25, 0.0, 0.75]];

/// A controller, and changes to the tool.
#[derive(Debug, Clone, PartialEq)]
pub struct Trial {
    /// The table of the controller, with its parameters.
    pub controller: String,
    /// Lines of `[manipulator]`.
    pub tool: String,
    /// Duration, s.
    pub seconds: f64,
    /// Tensions commanded from the first tick by a controller that is not built in, N.
    pub tensions_n: [f64; MAX_TENDONS],
    /// How a tool slides out of its outer tube, instead of a controller.
    pub deployment: Option<TubeDeployment>,
}

impl Trial {
    /// Holds a tension from the first tick.
    pub fn hold(tension_n: f64, tendon_friction: f64) -> Trial {
        Trial {
            controller: format!("[controller.hold]\ntension_n = {tension_n:?}\n"),
            tool: format!("tendon_friction = {tendon_friction:?}\n"),
            seconds: PULL_S,
            tensions_n: [0.0; MAX_TENDONS],
            deployment: None,
        }
    }

    /// Holds these tensions from the first tick, as a client can.
    pub fn pull(tensions_n: [f64; MAX_TENDONS]) -> Trial {
        Trial { controller: "external = true\n".to_owned(), tensions_n, ..Trial::hold(0.0, 0.0) }
    }

    /// Rolls a tool in its outer tube and slides it out within a given time.
    pub fn deploy(deployed_mm: f64, feed_mm_per_s: f64, roll_deg: f64, seconds: f64) -> Trial {
        let deployment = TubeDeployment {
            deployed_mm,
            feed_mm_per_s,
            roll_deg,
            burr_speed_rpm: BURR_RPM,
            retraction_mm: 0.0,
        };
        Trial {
            tool: String::new(),
            seconds,
            deployment: Some(deployment),
            ..Trial::pull([0.0; MAX_TENDONS])
        }
    }

    /// Pulls up and down in steps.
    pub fn sweep(most_n: f64, step_n: f64, tendon_friction: f64) -> Trial {
        let controller =
            format!("[controller.tension_sweep]\nmost_n = {most_n:?}\nstep_n = {step_n:?}\nsettle_s = 0.1\n");
        Trial { controller, ..Trial::hold(0.0, tendon_friction) }
    }

    /// Feeds, and pulls along a ramp over the first half of the feed.
    pub fn feed(tension_n: f64, feed_mm_per_s: f64, insertion_mm: f64) -> Trial {
        let ramp_mm = 0.5 * insertion_mm;
        let controller = format!(
            "[controller.curved_drilling]\nfeed_mm_per_s = {feed_mm_per_s:?}\ninsertion_mm = \
             {insertion_mm:?}\n\
             tension_n = {tension_n:?}\nramp_end_mm = {ramp_mm:?}\nburr_speed_rpm = {BURR_RPM:?}\nfeedback \
             = \"none\"\n"
        );
        let seconds = insertion_mm / feed_mm_per_s + 0.5;
        Trial { controller, tool: String::new(), seconds, ..Trial::hold(0.0, 0.0) }
    }

    /// The scene of the standard tool, in free space or in bone.
    ///
    /// # Errors
    /// A parameter is out of range.
    pub fn scene(&self, tolerance: &str, is_in_bone: bool) -> Result<(Scene, String), Failure> {
        let volume = if is_in_bone {
            "[volume]\nphantom = \"block\"\nbone_threshold_hu = -100\n[[predrill]]\nfrom_mm = [0.0, 0.0, \
             -60.0]\n\
             to_mm = [0.0, 0.0, 0.0]\ndiameter_mm = 7.0\n"
        } else {
            ""
        };
        let text = format!(
            "name = \"trial\"\n{tolerance}[run]\nmode = \"lockstep\"\nduration_s = \
             {:?}\n{volume}[manipulator]\n{}\
             [tool]\nburr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, \
             0.0]\n\
             [[controller]]\nname = \"driver\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\n{}",
            self.seconds, self.tool, self.controller
        );
        let scene = Scene::parse(&text, Path::new("trial.toml"));
        Ok((scene.map_err(Failure::failed)?, text))
    }
}

/// Diameter of the standard tool's pilot hole, mm.
pub const HOLE_MM: f64 = 7.0;
/// Bone beside a wider pilot hole, mm.
const BESIDE_MM: f64 = 4.5;

/// A block whose density increases along and across the tunnel, 200 to 440 kg/m³; its voxel grid is shifted
/// by `place`, in voxels. It is wide enough for a pilot hole of `hole_mm`.
pub fn block(place: [f64; 3], hole_mm: f64) -> Block {
    let shifted = |corner: [f64; 3]| [0, 1, 2].map(|a| corner[a] + place[a] * VOXEL_MM);
    let half_mm = (0.5 * hole_mm + BESIDE_MM).round().max(8.0);
    Block::new(shifted([-half_mm - 2.0, -half_mm, -38.0]), shifted([34.0, half_mm, 36.0]), VOXEL_MM, |p| {
        300.0 + 3000.0 * p.x + 1000.0 * p.z
    })
}

/// The pulls in free space.
pub fn pulls(pull: Pull) -> Vec<Trial> {
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
pub fn tunnels() -> [Trial; 3] {
    [Trial::feed(4.0, 4.0, 20.0), Trial::feed(10.0, 5.0, 20.0), Trial::feed(15.0, 5.0, 20.0)]
}

/// The larger; NaN wins.
pub fn larger(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() { f64::NAN } else { a.max(b) }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]
    use super::super::against::{Run, path};
    use super::*;

    /// Regression: the feeds waited for X-ray frames that were never sent, so the tunnels did not advance.
    #[test]
    fn a_feed_moves_the_burr() {
        let (scene, _) = Trial::feed(2.0, 20.0, 10.0).scene("", false).unwrap();
        let (path, _) = path(&Run::new(&scene, None)).unwrap();
        assert!((path[path.len() - 1] - path[0]).norm() > 8e-3);
    }
}
