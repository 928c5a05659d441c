//! The hard cases in bone.

use std::path::Path;

use ipc_types::scene::Scene;
use nalgebra::Vector3;

use crate::random::uniform;
use crate::reproduce::rig::Block;
use trabecula::failure::Failure;

/// Speed of the burr of the published experiment, rad/s: 2250 rpm.
const SPINNING: f64 = 235.6;
/// Densities, kg/m³: foam of 10 pounds per cubic foot, hard cancellous bone, cortex.
const FOAM: f64 = 160.0;
const CANCELLOUS: f64 = 800.0;
const CORTEX: f64 = 1900.0;

/// The controller's commands at a time.
#[derive(Debug, Clone, Copy)]
pub struct Drive {
    /// Tension of two antagonists, N.
    pub tension_n: [f64; 2],
    /// Speed of the burr, rad/s.
    pub burr_rad_per_s: f64,
    /// Depth along +z to which the arm inserts, m, and its feed, m/s.
    pub depth_m: f64,
    pub feed_m_per_s: f64,
}

/// A case: bone, tool, and commands.
pub struct BoneCase {
    /// Name.
    pub name: &'static str,
    /// Description.
    pub what: &'static str,
    /// Tables of the scene in addition to the volume's: pilot holes, contact, arm.
    keys: &'static [&'static str],
    voxel_mm: f64,
    density_kg_per_m3: fn(&Vector3<f64>) -> f64,
    /// Command at a time, s.
    pub drive: fn(f64) -> Drive,
    /// Time for which it is driven, s.
    pub driven_s: f64,
}

impl BoneCase {
    /// Returns the block of bone.
    pub fn block(&self) -> Block {
        Block::new([-12.0, -10.0, -40.0], [32.0, 10.0, 30.0], self.voxel_mm, self.density_kg_per_m3)
    }

    /// Returns the scene; the arm has no holder, and only what the case specifies.
    ///
    /// # Errors
    /// The scene is refused.
    pub fn scene(&self, model: &str, dt_ms: f64, seconds: f64) -> Result<Scene, Failure> {
        let text = format!(
            "name = \"bone\"\n[run]\nmode = \"lockstep\"\ndt_ms = {dt_ms:?}\nduration_s = {seconds:?}\n\
             [volume]\nphantom = \"block\"\nbone_threshold_hu = -100\n\
             [manipulator]\nmodel = \"{model}\"\ntendon_friction = 0.1\n{}\
             [tool]\nburr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nbend_toward = [1.0, 0.0, \
             0.0]\n\
             [[controller]]\nname = \"driver\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nexternal = true\n",
            self.keys.concat()
        );
        let scene = Scene::parse(&text, Path::new("bone.toml"));
        let mut scene = scene.map_err(|cause| Failure::failed(format!("{}: {cause}", self.name)))?;
        // The hard cases are to stay hard: no protective stop.
        scene.arm.max_force_n = Some(1e5);
        Ok(scene)
    }
}

/// A pilot hole that ends at the burr's start, half a millimetre wider than the burr.
const PILOT: &str = "[[predrill]]\nfrom_mm = [0.0, 0.0, -60.0]\nto_mm = [0.0, 0.0, 0.0]\ndiameter_mm = 7.0\n";
/// A bore of 9 mm through the whole block.
const BORE: &str = "[[predrill]]\nfrom_mm = [0.0, 0.0, -60.0]\nto_mm = [0.0, 0.0, 40.0]\ndiameter_mm = 9.0\n";

fn foam(_: &Vector3<f64>) -> f64 {
    FOAM
}

/// Tension up to `most_n` within half a second, then a feed.
fn feed(seconds: f64, most_n: f64, feed_m_per_s: f64, depth_m: f64) -> Drive {
    let ramp = (seconds / 0.5).min(1.0);
    let depth_m = if seconds < 0.5 { 0.0 } else { depth_m };
    Drive { tension_n: [most_n * ramp, 0.0], burr_rad_per_s: SPINNING, depth_m, feed_m_per_s }
}

/// Noise with a period of 1 ms, -1 to 1; the same at every step size.
fn noise(seconds: f64) -> f64 {
    let mut state = (seconds * 1e3 + 1e-6).floor() as u64;
    2.0 * uniform(&mut state) - 1.0
}

/// All cases.
pub const CASES: [BoneCase; 15] = [
    BoneCase {
        name: "edge of the pilot hole",
        what: "the burr leaves its pilot hole sideways: 10 N, fed at 2 mm/s over the cut edge",
        keys: &[PILOT],
        voxel_mm: 0.5,
        density_kg_per_m3: foam,
        drive: |s| feed(s, 10.0, 2e-3, 3e-3),
        driven_s: 2.1,
    },
    BoneCase {
        name: "jam past the stops",
        what: "25 N bend the tool into a wall while it is fed at 5 mm/s",
        keys: &[PILOT],
        voxel_mm: 0.5,
        density_kg_per_m3: foam,
        drive: |s| feed(s, 25.0, 5e-3, 8e-3),
        driven_s: 2.2,
    },
    BoneCase {
        name: "voxels of 1 mm",
        what: "a tunnel: 10 N, 5 mm/s, 8 mm deep",
        keys: &[PILOT],
        voxel_mm: 1.0,
        density_kg_per_m3: foam,
        drive: |s| feed(s, 10.0, 5e-3, 8e-3),
        driven_s: 2.2,
    },
    BoneCase {
        name: "voxels of 2 mm",
        what: "the same",
        keys: &[PILOT],
        voxel_mm: 2.0,
        density_kg_per_m3: foam,
        drive: |s| feed(s, 10.0, 5e-3, 8e-3),
        driven_s: 2.2,
    },
    BoneCase {
        name: "shell of one voxel",
        what: "6 N bend the tool onto a wall of one voxel; the burr does not spin",
        keys: &[],
        voxel_mm: 0.5,
        density_kg_per_m3: |p| if (6e-3..6.5e-3).contains(&p.x) { CANCELLOUS } else { 0.0 },
        drive: |s| Drive { burr_rad_per_s: 0.0, ..feed(s, 6.0, 1e-3, 0.0) },
        driven_s: 0.8,
    },
    BoneCase {
        name: "breakthrough",
        what: "drills straight through a plate of 3 mm at 4 mm/s",
        keys: &[],
        voxel_mm: 0.5,
        density_kg_per_m3: |p| if (4e-3..7e-3).contains(&p.z) { CANCELLOUS } else { 0.0 },
        drive: |s| feed(s, 0.0, 4e-3, 10e-3),
        driven_s: 3.1,
    },
    BoneCase {
        name: "slivers",
        what: "6 N, fed at 4 mm/s through sheets of one voxel, one voxel apart",
        keys: &[],
        voxel_mm: 0.5,
        density_kg_per_m3: |p| if p.z > 4e-3 && (p.z * 1e3).rem_euclid(1.0) < 0.5 { CANCELLOUS } else { 0.0 },
        drive: |s| feed(s, 6.0, 4e-3, 10e-3),
        driven_s: 3.1,
    },
    BoneCase {
        name: "pinched burr",
        what: "a stationary burr is pushed from a wide bore into one of 6 mm, narrower than itself",
        keys: &["[[predrill]]\nfrom_mm = [0.0, 0.0, -60.0]\nto_mm = [0.0, 0.0, 2.0]\ndiameter_mm = 9.0\n\
               [[predrill]]\nfrom_mm = [0.0, 0.0, 0.0]\nto_mm = [0.0, 0.0, 40.0]\ndiameter_mm = 6.0\n"],
        voxel_mm: 0.5,
        density_kg_per_m3: foam,
        drive: |s| Drive { burr_rad_per_s: 0.0, ..feed(s, 0.0, 4e-3, 5e-3) },
        driven_s: 1.9,
    },
    BoneCase {
        name: "stick and slip",
        what: "friction 1.5: 10 N hold a stationary burr against a bore while the arm oscillates at 8 mm/s",
        keys: &[BORE, "[contact]\nfriction = 1.5\n"],
        voxel_mm: 0.5,
        density_kg_per_m3: |_| CORTEX,
        drive: |s| {
            let there = (((s - 0.5).max(0.0) / 0.5) as u64).is_multiple_of(2);
            let depth_m = if there { 2e-3 } else { 0.0 };
            Drive { burr_rad_per_s: 0.0, ..feed(s, 10.0, 8e-3, depth_m) }
        },
        driven_s: 2.5,
    },
    BoneCase {
        name: "slack tendons",
        what: "antagonists take turns at 10 N, five times a second, in a bore",
        keys: &[BORE],
        voxel_mm: 0.5,
        density_kg_per_m3: |_| CORTEX,
        drive: |s| {
            let first = ((s * 5.0) as u64).is_multiple_of(2);
            let tension_n = if first { [10.0, 0.0] } else { [0.0, 10.0] };
            Drive { tension_n, burr_rad_per_s: 0.0, depth_m: 0.0, feed_m_per_s: 1e-3 }
        },
        driven_s: 1.0,
    },
    BoneCase {
        name: "noise at 1 kHz",
        what: "a tunnel whose 10 N carry noise of 2 N, new each millisecond",
        keys: &[PILOT],
        voxel_mm: 0.5,
        density_kg_per_m3: foam,
        drive: |s| {
            let drive = feed(s, 10.0, 4e-3, 4e-3);
            Drive { tension_n: [(drive.tension_n[0] + 2.0 * noise(s)).max(0.0), 0.0], ..drive }
        },
        driven_s: 1.6,
    },
    BoneCase {
        name: "elastic arm",
        what: "an arm with elastic joints drills a plate of cortex at 2 mm/s",
        keys: &["[arm.compliance]\njoint_stiffness_nm_per_rad = [4e4, 3e4, 2e4, 8e3, 6e3, 5e3]\n\
               joint_damping_nms_per_rad = [80.0, 60.0, 40.0, 16.0, 12.0, 10.0]\n"],
        voxel_mm: 0.5,
        density_kg_per_m3: |p| if p.z > 4e-3 { CORTEX } else { 0.0 },
        drive: |s| feed(s, 0.0, 2e-3, 4e-3),
        driven_s: 2.6,
    },
    BoneCase {
        name: "burr stops in bone",
        what: "a tunnel at 10 N whose burr stops after a second while the feed continues for 1 mm",
        keys: &[PILOT],
        voxel_mm: 0.5,
        density_kg_per_m3: foam,
        drive: |s| {
            let drive = feed(s, 10.0, 2e-3, 3e-3);
            Drive { burr_rad_per_s: if s < 1.5 { SPINNING } else { 0.0 }, ..drive }
        },
        driven_s: 2.1,
    },
    BoneCase {
        name: "fast arm",
        what: "approaches at 50 mm/s, its limit, with 1 N on a tendon, and stops 2 mm deep in foam",
        keys: &[],
        voxel_mm: 0.5,
        density_kg_per_m3: |p| if p.z > 12e-3 { FOAM } else { 0.0 },
        drive: |s| feed(s, 1.0, 0.05, 11e-3),
        driven_s: 1.0,
    },
    BoneCase {
        name: "foam beside cortex",
        what: "drills straight at 2 mm/s along the border of foam and cortex",
        keys: &[PILOT],
        voxel_mm: 0.5,
        density_kg_per_m3: |p| if p.x < 0.0 { FOAM } else { CORTEX },
        drive: |s| feed(s, 0.0, 2e-3, 3e-3),
        driven_s: 2.1,
    },
];
