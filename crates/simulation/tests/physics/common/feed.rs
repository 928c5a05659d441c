//! A straight feed into a block of one density: the same path at any voxel size. Shared by a test and an
//! example.

use std::path::Path;

use messages::{ArmMode, BurrMode, Command, CommandSource, Latched, LatchedCommand, State};
use nalgebra::Vector3;
use scene::Scene;
use simulation::bone::GridGeometry;
use simulation::{CtView, Simulation};

/// Bone of the block, HU.
const BLOCK_HU: i16 = 600;
/// Half the width of the block, m: half the tunnel of a 6.5 mm burr plus 1.5 mm.
const HALF_WIDTH_M: f64 = 4.8e-3;
/// Depth of the block, m: the longest feed plus 4 mm.
const DEPTH_M: f64 = 40.0e-3;
/// Feed, m/s.
const FEED_M_PER_S: f64 = 3.0e-3;
/// Time that the tool rests at the end, s.
const REST_S: f64 = 0.2;

/// A block with its face at z = 0, of cubic voxels.
pub struct Block {
    geometry: GridGeometry,
    hu: Vec<i16>,
}

impl Block {
    pub fn new(voxel_m: f64) -> Block {
        let across = (2.0 * HALF_WIDTH_M / voxel_m).round() as usize;
        let dims = [across, across, (DEPTH_M / voxel_m).round() as usize];
        let corner = Vector3::new(-0.5 * across as f64 * voxel_m, -0.5 * across as f64 * voxel_m, 0.0);
        let geometry = GridGeometry::axis_aligned(dims, [voxel_m; 3], corner.add_scalar(0.5 * voxel_m));
        Block { hu: vec![BLOCK_HU; geometry.voxel_count()], geometry }
    }

    pub fn ct(&self) -> CtView<'_> {
        CtView { geometry: self.geometry, hu: &self.hu }
    }

    pub fn voxel_mm3(&self) -> f64 {
        self.geometry.voxel_volume_m3() * 1e9
    }
}

/// The scene: the burr's centre starts 4 mm in front of the block.
pub fn scene(model: &str) -> Scene {
    let text = format!(
        "name = \"feed\"\n[run]\nmode = \"lockstep\"\nduration_s = 60.0\n[volume]\nphantom = \"block\"\n\
         [manipulator]\nmodel = \"{model}\"\n\
         [tool]\nburr_start_mm = [0.0, 0.0, -4.0]\ndirection = [0.0, 0.0, 1.0]\n\
         bend_toward = [1.0, 0.0, 0.0]\n\
         [[controller]]\nname = \"feed\"\ndrives = [\"tendon\", \"arm\", \"burr\"]\nexternal = true\n"
    );
    let Ok(scene) = Scene::parse(&text, Path::new("feed.toml")) else { unreachable!("the scene is valid") };
    scene
}

/// Ticks of a feed over `insertion_m` at 1 kHz, including start and rest.
pub fn ticks(insertion_m: f64) -> u64 {
    ((insertion_m / FEED_M_PER_S + REST_S) * 1e3) as u64
}

/// u_k: the feed along +z with the burr on, sent once and then held.
pub fn latched(tick: u64, insertion_m: f64) -> Latched {
    let command = Command {
        sequence: 1,
        arm_mode: ArmMode::Insert.code(),
        arm_axis: [0.0, 0.0, 1.0],
        arm_depth_m: insertion_m,
        arm_speed_m_per_s: FEED_M_PER_S,
        burr_mode: BurrMode::Speed.code(),
        burr_speed_rad_per_s: 8000.0 * core::f64::consts::TAU / 60.0,
        ..Command::zeroed()
    };
    let source = if tick == 0 { CommandSource::Fresh } else { CommandSource::Held }.code();
    let mut latched = Latched { tick, controller_count: 1, ..Latched::zeroed() };
    latched.commands[0] = LatchedCommand { source, controller_index: 0, age_ticks: tick, command };
    latched
}

/// Result of a feed.
#[derive(Debug, Clone)]
pub struct FeedResult {
    /// The state at the end.
    pub end: State,
    /// Position of the burr's front every 100 ticks, m.
    pub path_m: Vec<Vector3<f64>>,
    /// Largest normal force of the burr, N.
    pub most_force_n: f64,
    /// Mean normal force of the burr over the second half of the feed, N.
    pub mean_force_n: f64,
    /// Largest number of voxels removed in a tick.
    pub most_removed: usize,
}

impl FeedResult {
    /// Largest distance between two paths at equal times, m.
    pub fn apart_m(&self, other: &FeedResult) -> f64 {
        self.path_m.iter().zip(&other.path_m).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max)
    }
}

/// Feeds over `insertion_m`.
pub fn feed(simulation: &mut Simulation<'_>, insertion_m: f64) -> FeedResult {
    let ticks = ticks(insertion_m);
    let mut fed = FeedResult {
        end: *simulation.state(),
        path_m: Vec::new(),
        most_force_n: 0.0,
        mean_force_n: 0.0,
        most_removed: 0,
    };
    let (mut sum_n, mut counted) = (0.0, 0);
    for tick in 0..ticks {
        let stepped = simulation.step(&latched(tick, insertion_m));
        assert!(stepped.is_ok(), "tick {tick}: {stepped:?}");
        let state = simulation.state();
        if tick % 100 == 0 {
            fed.path_m.push(Vector3::from(state.t_world_tip.position_m));
        }
        fed.most_force_n = fed.most_force_n.max(state.burr_force_n);
        fed.most_removed = fed.most_removed.max(simulation.removed().len());
        if tick > ticks / 2 && (tick as f64) * 1e-3 < insertion_m / FEED_M_PER_S - 0.2 {
            (sum_n, counted) = (sum_n + state.burr_force_n, counted + 1);
        }
    }
    fed.mean_force_n = sum_n / f64::from(counted.max(1));
    fed.end = *simulation.state();
    fed
}
