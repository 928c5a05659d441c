//! Simulated X-ray frames (DRR, digitally reconstructed radiographs): C-arm geometry, projectors, tool,
//! detector, display.
//!
//! A frame is a pure function of the CT, the set of removed voxels, the tool's parts, the C-arm and the frame
//! seed:
//!
//! 1. Anatomy: the line integral of attenuation along the ray to each pixel centre, by [`slice_ordered`],
//!    [`joseph`] or [`siddon`]. It is cached while the C-arm is stationary; after [`DrrRenderer::remove`]
//!    only the pixels that see a removed voxel are recomputed.
//! 2. Tool and objects: closed-form chords of their parts ([`ToolPart`]); anatomy inside the union of their
//!    envelopes is subtracted. [`surroundings`]: the arm, the scene's objects and bodies.
//! 3. Detector ([`DetectorParameters`]): Beer-Lambert, [`scatter`], seeded quantum noise, blur. Then the
//!    monitor image ([`DisplayParameters`]), as mono16.
//!
//! The CT is a borrowed `&[i16]` of Hounsfield units and can be in shared memory. The renderer keeps one bit
//! per voxel for what is drilled and one byte per block of 8x8x8 voxels for what is empty; [`slice_ordered`]
//! also keeps reordered copies.
//!
//! **Boundary:** this crate only computes. It opens no file, reads no clock and starts no thread: the caller
//! passes in a [`Machine`], which provides worker threads, memory and a clock. `drr_proc` implements it for
//! the real machine and runs the X-ray process. [`Labels`] are a frame's ground truth, for training and
//! registration. [`from_scene`] and [`message`] translate scenes and messages; [`frame`] renders the content
//! of a frame message.
//!
//! **Invariants:** a frame's bits do not depend on the number of threads, the vector instructions, the
//! [`Machine`], or earlier frames: a cached frame equals a full render bit for bit. A refused call changes
//! nothing.
//!
//! ```
//! use xray::{
//!     CArm, DetectorFormat, DrrParameters, DrrRenderer, FrameSeed, Grid, Machine, PositionerAngles, Tool,
//!     VolumeView,
//! };
//!
//! /// Threads from rayon, memory from the heap.
//! struct Desk;
//!
//! impl Machine for Desk {
//!     fn workers(&self, threads: usize) -> Result<rayon::ThreadPool, String> {
//!         rayon::ThreadPoolBuilder::new().num_threads(threads).build().map_err(|cause| cause.to_string())
//!     }
//! }
//!
//! # fn main() -> Result<(), xray::DrrError> {
//! let grid = Grid::axis_aligned([32, 32, 32], [1e-3; 3], [0.0; 3])?;
//! let hu = vec![200_i16; 32 * 32 * 32];
//! let view = VolumeView::new(grid, &hu)?;
//! let mut renderer = DrrRenderer::new(&view, DrrParameters::default(), &Desk)?;
//! let format = DetectorFormat { columns: 64, rows: 64, pixel_pitch_m: [1e-3; 2] };
//! let c_arm = CArm::from_positioner_angles([0.016; 3], PositionerAngles::AP, 0.7, 1.0, format)?;
//! let (tool, seed) = (Tool::default(), FrameSeed { seed: 1, frame: 0 });
//! let mut image = vec![0_u16; 64 * 64];
//!
//! // The first frame of a C-arm is computed in full, the next only where a voxel was removed.
//! let first = renderer.render(&view, &c_arm, &tool, seed, &mut image)?;
//! assert_eq!(first.rays_traced, 64 * 64);
//! renderer.remove(&view, &[0, 1, 2])?;
//! let second = renderer.render(&view, &c_arm, &tool, seed, &mut image)?;
//! assert!(second.rays_traced < 64 * 64);
//! # Ok(())
//! # }
//! ```

pub mod arm_model;
mod attenuation;
mod buckets;
mod camera;
mod carm;
mod detector;
mod displaced;
mod display;
mod error;
mod exposure;
mod exposure_loops;
pub mod frame;
pub mod from_scene;
mod grid;
pub mod joseph;
mod label_walk;
mod labels;
pub mod ladder;
mod lane_math;
mod lanes;
mod machine;
pub mod message;
mod pieces;
mod placement;
pub mod ray;
pub mod reference;
pub mod removal;
mod renderer;
pub mod scatter;
pub mod siddon;
pub mod slice_ordered;
mod solids;
mod spectrum;
pub mod surroundings;
mod tool;
mod tool_layer;
pub mod tool_model;
mod tool_row;
mod vector;

pub use attenuation::{ALUMINIUM_G_PER_CM3, Material, MuTable, cortical_bone_hu};
pub use camera::{Camera, Positioner};
pub use carm::{CArm, DetectorFormat, PositionerAngles, Projection};
pub use detector::{DetectorParameters, FrameSeed, blur_row, gaussian_weights, photon_number};
pub use display::{DisplayParameters, Scale, Window, WindowLimits, window_limits};
pub use error::DrrError;
pub use exposure::Output;
pub use grid::{Grid, VolumeView};
pub use labels::{Class, Keypoint, LabelRequest, Labels, Marker, Visibility, keypoint_name};
pub use machine::{Machine, Memory};
pub use renderer::{DrrParameters, DrrRenderer, FrameReport, Projector, RenderKind, Shot};
pub use scene::{AntiScatterGrid, Display, PixelCentre, Scatter, ScatterModel, Spectrum};
pub use solids::PlacedSolids;
pub use spectrum::{SpectrumTable, weights};
pub use tool::{Crossing, Notch, PlacedObjects, PreparedPart, Tool, ToolPart, join_intervals};
