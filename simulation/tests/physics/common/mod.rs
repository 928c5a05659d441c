//! Scenes and bone that tests share.
#![allow(dead_code, reason = "each test takes some of it")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "a scene that cannot be read is a failed test")]

pub mod arm;
pub mod block;
pub mod feed;
pub mod tool;
pub mod tunnel;

use std::path::Path;

use nalgebra::Vector3;
use scene::{Scene, SceneError};
use simulation::bone::GridGeometry;
use test_support::scenes::TOOL;

/// A tunnel in [`bone`], tight around the tool.
pub const TUNNEL: &str = r#"
name = "tight_tunnel"
run = { mode = "lockstep", duration_s = 3.0 }
volume = { phantom = "block" }
[[predrill]]
from_mm = [0.0, 0.0, -110.0]
to_mm = [0.0, 0.0, 0.0]
diameter_mm = 6.6
"#;

/// A scene with that tool.
pub fn try_scene(text: &str) -> Result<Scene, SceneError> {
    Scene::parse(&format!("{text}{TOOL}"), Path::new("test.toml"))
}

/// A scene with that tool, which must be right.
pub fn scene(text: &str) -> Scene {
    try_scene(text).unwrap()
}

/// Uniform bone, 0.5 mm voxels, 24 × 24 × 120 mm, the tool along +z inside it.
pub fn bone() -> (GridGeometry, Vec<i16>) {
    let dims = [48, 48, 240];
    let origin = Vector3::new(-11.75e-3, -11.75e-3, -99.75e-3);
    (GridGeometry::axis_aligned(dims, [0.5e-3; 3], origin), vec![400; dims.iter().product()])
}
