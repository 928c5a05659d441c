//! The scatter of a renderer's frames.

use scene::{AntiScatterGrid, ScatterModel};

use super::kernel::Kernels;
use super::{MonteCarlo, Phantom, nodes_of};
use crate::attenuation::Material;
use crate::carm::CArm;
use crate::detector::{blur_row, gaussian_weights};
use crate::error::DrrError;
use crate::exposure::Anatomy;
use crate::exposure_loops::column_blur;
use crate::grid::VolumeView;
use crate::removal::RemovedVoxels;
use crate::renderer::DrrParameters;
use crate::spectrum::{Mixture, SpectrumTable, weights};
use crate::vector::{add_scaled, scale};

/// Nodes of the kernels along the longer side of the detector.
const KERNEL_NODES: usize = 32;
/// Standard deviation of the smoothing of the Monte Carlo image, in nodes.
const SMOOTHING: f64 = 1.5;
/// Every how many voxels the patient's centre of mass is sampled, along each axis.
const STRIDE: usize = 4;

/// Scattered signal over a detector, as a fraction of the open field's signal; bilinear between nodes.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ScatterImage {
    columns: usize,
    rows: usize,
    values: Vec<f32>,
    /// Nodes per pixel along a row and along a column.
    per_pixel: [f64; 2],
    /// Number of voxels that were removed.
    pub removed: usize,
}

impl ScatterImage {
    /// The signal of pixels `from..` of a row.
    #[inline]
    pub fn read(&self, row: usize, from: usize, out: &mut [f64]) {
        let place = |pixel: usize, per_pixel: f64, nodes: usize| {
            let x = ((pixel as f64 + 0.5) * per_pixel - 0.5).clamp(0.0, (nodes - 1) as f64);
            let below = x as usize;
            (below, (below + 1).min(nodes - 1), x - below as f64)
        };
        let (above, below, down) = place(row, self.per_pixel[1], self.rows);
        let node = |row: usize, column: usize| f64::from(self.values[row * self.columns + column]);
        let between_rows = |column: usize| {
            let (a, b) = (node(above, column), node(below, column));
            a + down * (b - a)
        };
        // Neighbouring pixels lie between the same nodes.
        let (mut left, mut ends) = (usize::MAX, (0.0, 0.0));
        for (out, pixel) in out.iter_mut().zip(from..) {
            let (here, right, across) = place(pixel, self.per_pixel[0], self.columns);
            if here != left {
                (left, ends) = (here, (between_rows(here), between_rows(right)));
            }
            *out = ends.0 + across * (ends.1 - ends.0);
        }
    }

    /// The signal of one pixel.
    pub fn at(&self, row: usize, column: usize) -> f64 {
        let mut value = [0.0];
        self.read(row, column, &mut value);
        value[0]
    }
}

/// How a renderer computes scatter.
#[derive(Debug, Clone)]
pub(crate) struct Stage {
    method: Method,
    beam: Vec<(f64, f64)>,
    densities: Densities,
    fill_hu: i16,
    /// Transmission of scatter over that of the primary.
    passing: f32,
}

#[derive(Debug, Clone)]
enum Method {
    Kernel(Box<Kernels>),
    MonteCarlo(MonteCarlo),
}

/// Hounsfield units to densities of water and cortical bone, as the frame's attenuation takes them.
#[derive(Debug, Clone, Copy)]
struct Densities {
    mixture: Option<Mixture>,
    air_below_hu: i16,
}

impl Densities {
    fn of(&self, hu: i16) -> [f32; 2] {
        if hu < self.air_below_hu {
            return [0.0; 2];
        }
        let hu = f64::from(hu);
        let (water, bone) =
            self.mixture.map_or(((1.0 + hu / 1000.0).max(0.0), 0.0), |mixture| mixture.of(hu));
        [water as f32, bone as f32]
    }
}

impl Stage {
    /// Prepares the scatter that the parameters ask for; `None` without scatter.
    ///
    /// # Errors
    /// A parameter is out of range.
    pub fn new(
        view: &VolumeView<'_>,
        parameters: &DrrParameters,
        table: Option<&SpectrumTable>,
    ) -> Result<Option<Self>, DrrError> {
        let Some(scatter) = parameters.scatter else { return Ok(None) };
        let densities =
            Densities { mixture: table.map(SpectrumTable::mixture), air_below_hu: parameters.air_below_hu };
        let energy_kev = parameters.energy_kev;
        let beam = parameters.spectrum.as_ref().map_or_else(|| vec![(energy_kev, 1.0)], weights);
        let method = match scatter.model {
            ScatterModel::None => return Ok(None),
            ScatterModel::Kernel => {
                let centre_m = centre_m(view, &densities);
                Method::Kernel(Box::new(Kernels::new(&beam, energy_kev, centre_m)?))
            }
            ScatterModel::MonteCarlo => {
                let monte_carlo = MonteCarlo { photons: scatter.photons, ..MonteCarlo::default() };
                monte_carlo.validate()?;
                Method::MonteCarlo(monte_carlo)
            }
        };
        let passing = |grid: AntiScatterGrid| grid.scatter_transmission / grid.primary_transmission;
        let passing = parameters.grid.map_or(1.0, passing) as f32;
        Ok(Some(Self { method, beam, densities, fill_hu: parameters.fill_hu, passing }))
    }

    /// The scatter of a frame. Depends on the volume, the removed voxels, the C-arm and these images of the
    /// anatomy alone.
    ///
    /// # Errors
    /// The C-arm is invalid.
    pub fn image(
        &self,
        view: &VolumeView<'_>,
        removed: &RemovedVoxels,
        c_arm: &CArm,
        anatomy: Anatomy<'_>,
        table: Option<&SpectrumTable>,
    ) -> Result<ScatterImage, DrrError> {
        let most = match &self.method {
            Method::Kernel(_) => KERNEL_NODES,
            Method::MonteCarlo(monte_carlo) => monte_carlo.nodes,
        };
        let (columns, rows) = nodes_of(c_arm, most);
        let mut values = match &self.method {
            Method::Kernel(kernels) => kernels.image(c_arm, anatomy, table, (columns, rows)),
            Method::MonteCarlo(monte_carlo) => {
                let phantom = Phantom::of_volume(view, removed, self.fill_hu, |hu| self.densities.of(hu))?;
                let estimate = monte_carlo.estimate(&phantom, c_arm, &self.beam)?;
                smoothed(&estimate.image(), columns)
            }
        };
        values.iter_mut().for_each(|value| *value *= self.passing);
        let per_pixel = [columns as f64 / f64::from(c_arm.columns), rows as f64 / f64::from(c_arm.rows)];
        Ok(ScatterImage { columns, rows, values, per_pixel, removed: removed.count() })
    }
}

/// Centre of mass of a volume's intact voxels; its middle if it is empty.
fn centre_m(view: &VolumeView<'_>, densities: &Densities) -> [f64; 3] {
    let grid = view.grid();
    let [nx, ny, nz] = grid.dims();
    let bone_density = Material::CorticalBone.density_g_per_cm3();
    let (mut mass, mut moment) = (0.0, [0.0; 3]);
    for z in (0..nz).step_by(STRIDE) {
        for y in (0..ny).step_by(STRIDE) {
            let row = &view.hu()[nx * (y + ny * z)..][..nx];
            for (x, &hu) in row.iter().enumerate().step_by(STRIDE) {
                let [water, bone] = densities.of(hu).map(f64::from);
                let density = water + bone_density * bone;
                mass += density;
                moment = add_scaled(moment, density, [x as f64, y as f64, z as f64]);
            }
        }
    }
    let middle = grid.dims().map(|n| (n as f64 - 1.0) / 2.0);
    grid.index_to_world(if mass > 0.0 { scale(moment, 1.0 / mass) } else { middle })
}

/// A smoothed image of nodes.
fn smoothed(image: &[f64], columns: usize) -> Vec<f32> {
    let weights: Vec<f32> = gaussian_weights(SMOOTHING).into_iter().map(|w| w as f32).collect();
    let image: Vec<f32> = image.iter().map(|x| *x as f32).collect();
    let (mut along, mut out) = (vec![0.0; image.len()], vec![0.0; image.len()]);
    for (row, out) in image.chunks(columns).zip(along.chunks_mut(columns)) {
        blur_row(row, &weights, out);
    }
    for (row, out) in out.chunks_mut(columns).enumerate() {
        column_blur(&along, columns, row, 0, &weights, out);
    }
    out
}
