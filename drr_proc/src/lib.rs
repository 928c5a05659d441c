//! Simulated X-ray frames (DRR, digitally reconstructed radiographs): C-arm geometry, projectors, tool, detector.
//!
//! A frame is a pure function of the CT, the set of removed voxels, the tool's parts, the C-arm and the frame seed, and has the
//! same bits for any number of threads:
//!
//! 1. Anatomy: the line integral of attenuation along the ray to each pixel centre, by [`joseph`] or [`siddon`]. It is
//!    cached for a standing C-arm; [`DrrRenderer::remove`] marks the pixels a removed voxel can reach, and only those are
//!    traced again, from scratch, so the cache always equals a full render bit for bit.
//! 2. Tool: closed-form chords of its parts ([`tool`]); the anatomy inside the union of their envelopes is taken out.
//! 3. Detector ([`detector`]): Beer-Lambert, seeded quantum noise, blur. Then [`display`]: what a monitor shows, as mono16.
//!
//! The CT is a borrowed `&[i16]` of Hounsfield units in shared memory. It is never copied or converted; the renderer
//! keeps one bit a voxel for what is drilled and one byte a block of 8x8x8 voxels for what is empty.
//!
//! ```
//! use drr_proc::{CArm, DetectorFormat, DrrParameters, DrrRenderer, FrameSeed, Grid, PositionerAngles, Tool, VolumeView};
//!
//! # fn main() -> Result<(), drr_proc::DrrError> {
//! let grid = Grid::axis_aligned([32, 32, 32], [1e-3; 3], [0.0; 3])?;
//! let hu = vec![200_i16; 32 * 32 * 32];
//! let view = VolumeView::new(grid, &hu)?;
//! let mut renderer = DrrRenderer::new(&view, DrrParameters::default())?;
//! let format = DetectorFormat { columns: 64, rows: 64, pixel_pitch_m: [1e-3; 2] };
//! let c_arm = CArm::from_positioner_angles([0.016; 3], PositionerAngles::AP, 0.7, 1.0, format)?;
//! let mut image = vec![0_u16; 64 * 64];
//! renderer.remove(&view, &[0, 1, 2])?;
//! let report = renderer.render(&view, &c_arm, &Tool::default(), FrameSeed { seed: 1, frame: 0 }, &mut image)?;
//! assert_eq!(report.rays_traced, 64 * 64);
//! # Ok(())
//! # }
//! ```

pub mod attenuation;
pub mod camera;
pub mod carm;
pub mod detector;
mod displaced;
pub mod display;
mod error;
pub mod exposure;
pub mod grid;
pub mod joseph;
pub mod ladder;
pub mod lane_math;
mod lanes;
pub mod process;
pub mod ray;
pub mod reference;
pub mod removal;
pub mod renderer;
pub mod siddon;
pub mod slice_ordered;
pub mod spectrum;
pub mod tool;
mod tool_layer;
mod tool_row;
mod vector;

pub use attenuation::{HuLaw, Material};
pub use camera::{Camera, PixelCentre, Positioner};
pub use carm::{CArm, DetectorFormat, PositionerAngles, Projection};
pub use detector::{DetectorParameters, FrameSeed};
pub use display::{DisplayMode, DisplayParameters, Window};
pub use error::DrrError;
pub use exposure::Output;
pub use grid::{Grid, VolumeView};
pub use renderer::{DrrParameters, DrrRenderer, FrameReport, Projector, RenderKind};
pub use spectrum::Spectrum;
pub use tool::{Notch, Tool, ToolPart};
