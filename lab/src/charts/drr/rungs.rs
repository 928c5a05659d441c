//! Writes `crates/xray/src/rungs.csv`, from which a scene's `tolerance.drr_rel` chooses.
//!
//! The thigh of [`reference`](mod@reference) in 512 x 512 x 400 voxels of 0.5 mm; three poses, 512 x 512
//! pixels. For each projector: the largest error over the poses against Siddon's sum in f64, relative and
//! r.m.s., on every eighth pixel in both directions; and the median time of full frames with two threads.

use std::path::Path;
use std::time::Instant;

use drr_proc::ThisMachine;
use xray::reference::{self, relative_rms};
use xray::{
    CArm, DetectorFormat, DrrError, DrrRenderer, FrameSeed, Grid, Projector, Tool, VolumeView, ladder,
};

use super::{POSES, failed, parameters, projectors};
use crate::bench::samples::median;
use crate::phantom::{Phantom, Solid};
use trabecula::failure::Failure;

/// Pixels along each side of the detector, and the stride at which the error is sampled.
const SIDE: u32 = 512;
const STRIDE: u32 = 8;
const FIELD_M: f64 = 0.3072;

/// The problem on which errors are measured.
struct Problem {
    grid: Grid,
    hu: Vec<i16>,
    c_arms: Vec<CArm>,
}

impl Problem {
    fn new() -> Result<Self, DrrError> {
        let grid = Grid::centred([512, 512, 400], [0.5e-3; 3])?;
        let solids = reference::thigh(0.256 / 0.24).into_iter().map(Solid::Ellipsoid).collect();
        let format =
            DetectorFormat { columns: SIDE, rows: SIDE, pixel_pitch_m: [FIELD_M / f64::from(SIDE); 2] };
        let c_arms = POSES.into_iter().map(|(_, primary, secondary)| {
            let angles = xray::PositionerAngles::from_degrees(primary, secondary);
            CArm::from_positioner_angles([0.0; 3], angles, 0.7, 1.0, format)
        });
        Ok(Self {
            grid,
            hu: Phantom { solids }.voxelise(&grid, 2),
            c_arms: c_arms.collect::<Result<_, _>>()?,
        })
    }

    fn view(&self) -> Result<VolumeView<'_>, DrrError> {
        VolumeView::new(self.grid, &self.hu)
    }

    /// Returns the line integrals of every eighth pixel, for all poses in order.
    fn integrals(&self, projector: Projector) -> Result<Vec<f64>, DrrError> {
        let view = self.view()?;
        let mut renderer = DrrRenderer::new(&view, parameters(projector, 2), &ThisMachine)?;
        let mut all = Vec::new();
        for c_arm in &self.c_arms {
            // Projectors that trace rays one by one do not need the neighbouring rays.
            let alone = matches!(projector, Projector::Siddon | Projector::Joseph);
            let (c_arm, stride) = if alone { (every(c_arm, STRIDE), 1) } else { (*c_arm, STRIDE as usize) };
            let mut image = vec![0; c_arm.pixels()];
            renderer.render(&view, &c_arm, &Tool::default(), FrameSeed::default(), &mut image)?;
            let rows = renderer.anatomy().chunks(c_arm.columns as usize).step_by(stride);
            all.extend(rows.flat_map(|row| row.iter().step_by(stride).copied()));
        }
        Ok(all)
    }

    /// Returns the median time of the poses' frames, in ms.
    fn frame_ms(&self, projector: Projector, rounds: usize) -> Result<f64, DrrError> {
        let view = self.view()?;
        let mut renderer = DrrRenderer::new(&view, parameters(projector, 2), &ThisMachine)?;
        let mut times = Vec::new();
        for c_arm in self.c_arms.iter().cycle().take(rounds * self.c_arms.len()) {
            renderer.prepare(&view, c_arm)?;
            let mut image = vec![0; c_arm.pixels()];
            let began = Instant::now();
            renderer.render(&view, c_arm, &Tool::default(), FrameSeed::default(), &mut image)?;
            times.push(began.elapsed().as_secs_f64() * 1e3);
        }
        Ok(median(&times))
    }

    /// Returns each projector with its largest error over the poses.
    fn errors(&self) -> Result<Vec<(Projector, f64)>, DrrError> {
        let exact = self.integrals(Projector::Siddon)?;
        let pixels = exact.len() / self.c_arms.len();
        projectors()
            .into_iter()
            .filter(|(_, projector)| ladder::line_of(*projector, 0.0, 0.0).is_some())
            .map(|(_, projector)| {
                let image = self.integrals(projector)?;
                let poses = image.chunks(pixels).zip(exact.chunks(pixels));
                Ok((projector, poses.map(|(a, b)| relative_rms(a, b)).fold(0.0, f64::max)))
            })
            .collect()
    }
}

/// Returns the C-arm reduced to every `stride`-th pixel, starting with the first.
fn every(c_arm: &CArm, stride: u32) -> CArm {
    let (columns, rows) = (c_arm.columns.div_ceil(stride), c_arm.rows.div_ceil(stride));
    let middle = |n: u32| f64::from(stride) * (f64::from(n) - 1.0) / 2.0;
    CArm {
        detector_centre_m: c_arm.pixel_m(middle(columns), middle(rows)),
        pixel_pitch_m: c_arm.pixel_pitch_m.map(|p| p * f64::from(stride)),
        columns,
        rows,
        ..*c_arm
    }
}

/// Measures the projectors and writes the file.
///
/// # Errors
/// A volume that does not fit into memory, a file that cannot be written (1).
pub fn write(path: &Path, rounds: usize) -> Result<(), Failure> {
    let problem = Problem::new().map_err(failed)?;
    let mut text = "projector,parameter,error_rel,frame_ms\n".to_owned();
    for (projector, error_rel) in problem.errors().map_err(failed)? {
        // The slow projectors' times vary little.
        let rounds = if projector == Projector::Siddon { 1 } else { rounds };
        let frame_ms = problem.frame_ms(projector, rounds).map_err(failed)?;
        text.extend(ladder::line_of(projector, error_rel, frame_ms).map(|line| line + "\n"));
    }
    output_file::write(path, &text)?;
    say!("{}", text.trim_end());
    Ok(())
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a panic fails the test")]
mod tests {
    use super::*;

    #[test]
    fn the_table_in_the_tree_is_what_the_command_measures() {
        let measured = Problem::new().unwrap().errors().unwrap();
        let table = ladder::rungs();
        assert_eq!(measured.len(), table.len());
        for (projector, error_rel) in measured {
            let rung = table.iter().find(|rung| rung.projector == projector).unwrap();
            // Errors do not depend on the machine. Four digits are written; 1 % allows for a different
            // summation order in a kernel.
            assert!(
                (error_rel - rung.error_rel).abs() <= 0.01 * error_rel,
                "{projector:?}: {error_rel:e}, the table says {:e}: update it with `trabecula-lab chart drr \
                 --rungs`",
                rung.error_rel
            );
        }
    }
}
