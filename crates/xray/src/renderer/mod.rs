//! The renderer: caches the anatomy of a stationary C-arm, draws the frame's tool over it, and exposes both.

mod batch;
mod labelling;
mod layer;
mod parameters;
mod standing;
mod trace;

pub use batch::Shot;
pub use parameters::{DrrParameters, FrameReport, Projector, RenderKind};

use std::sync::Mutex;

use crate::attenuation::{ENERGY_RANGE_KEV, Material, MuTable};
use crate::carm::CArm;
use crate::detector::FrameSeed;
use crate::display::window_limits;
use crate::error::{DrrError, check_range};
use crate::exposure::{Exposure, Metal, Output};
use crate::grid::{Grid, VolumeView};
use crate::machine::Machine;
use crate::removal::RemovedVoxels;
use crate::scatter::Stage;
use crate::slice_ordered::SliceOrdered;
use crate::solids::Solids;
use crate::spectrum::SpectrumTable;
use crate::tool::Tool;
use crate::tool_layer::{DisplacedAnatomy, PlacedTool};
use batch::Lane;
use labelling::StandingLabels;
use layer::{Layer, LayerWork};
use standing::{CachedView, DirtyMarker};

/// Renders frames of one CT. Holds small data derived from the CT, the removed voxels, and the C-arm's cache.
pub struct DrrRenderer {
    parameters: DrrParameters,
    grid: Grid,
    /// Attenuation at the frame's energy; with a spectrum, metres of tissue.
    tissue: Layer,
    /// With a spectrum, metres of cortical bone.
    bone: Option<Layer>,
    removed: RemovedVoxels,
    scatter: Option<Stage>,
    exposure: Exposure,
    tool: PlacedTool,
    solids: Solids,
    pool: rayon::ThreadPool,
    standing: Option<CachedView>,
    /// Memory for the next one-off frame; while one is being rendered, the cached image.
    aside: Option<CachedView>,
    /// The voxels on the rays of the last labelled frame.
    labelled: Option<StandingLabels>,
    /// One per thread, created by the first batch.
    lanes: Vec<Mutex<Lane>>,
}

impl DrrRenderer {
    /// Reads the CT once to find its empty blocks; keeps no copy of it.
    ///
    /// # Errors
    /// A parameter is out of range (the error names it), or worker threads cannot be started.
    pub fn new(
        view: &VolumeView<'_>,
        parameters: DrrParameters,
        machine: &'static dyn Machine,
    ) -> Result<Self, DrrError> {
        let (low, high) = ENERGY_RANGE_KEV;
        check_range("energy_kev", parameters.energy_kev, low, high, "30 to 120 keV")?;
        check_range("threads", parameters.threads as f64, 1.0, 64.0, "1 to 64")?;
        let mut detector = parameters.detector;
        if let Some(grid) = &parameters.grid {
            check_range("primary_transmission", grid.primary_transmission, 0.01, 1.0, "0.01 to 1")?;
            check_range("scatter_transmission", grid.scatter_transmission, 0.0, 1.0, "0 to 1")?;
            detector.photons_per_pixel *= grid.primary_transmission;
        }
        detector.validate()?;
        parameters.display.validate()?;
        let threads = parameters.threads;
        let pool = machine.workers(threads).map_err(|reason| DrrError::Threads { threads, reason })?;
        let air = parameters.air_below_hu;
        let (tissue, bone, spectrum) = match &parameters.spectrum {
            None => (MuTable::new(parameters.energy_kev, air)?, None, None),
            Some(spectrum) => {
                let table = SpectrumTable::new(spectrum)?;
                let mixture = table.mixture();
                let tissue = MuTable::of(air, |hu| mixture.of(hu).0);
                (tissue, Some(MuTable::of(air, |hu| mixture.of(hu).1)), Some(table))
            }
        };
        // One Hounsfield unit of water scaling, so that this law is stored without rounding. A spectrum's
        // fractions are near 1.
        let unit_per_m = match spectrum {
            None => Material::Water.mu_per_m(parameters.energy_kev)? / 1000.0,
            Some(_) => 1e-3,
        };
        let layer = |table| pool.install(|| Layer::new(view, table, unit_per_m, &parameters, machine));
        let scatter = Stage::new(view, &parameters, spectrum.as_ref())?;
        Ok(Self {
            grid: *view.grid(),
            tissue: layer(tissue)?,
            bone: bone.map(layer).transpose()?,
            parameters,
            removed: RemovedVoxels::new(view.grid()),
            scatter,
            exposure: Exposure::new(detector, parameters.display, spectrum),
            tool: PlacedTool::default(),
            solids: Solids::default(),
            pool,
            standing: None,
            aside: None,
            labelled: None,
            lanes: Vec::new(),
        })
    }

    /// Creates the reordered copy of the volume that this C-arm needs, and the memory of its images, so that
    /// the first frame does not wait for them: the system allocates a page only when it is first written.
    ///
    /// # Errors
    /// The view has another grid, the C-arm is invalid, or the copy does not fit into free memory.
    pub fn prepare(&mut self, view: &VolumeView<'_>, c_arm: &CArm) -> Result<(), DrrError> {
        self.check_view(view)?;
        c_arm.validate()?;
        let Self { tissue, bone, removed, pool, .. } = self;
        let with_bone = bone.is_some();
        for slices in core::iter::once(tissue).chain(bone).filter_map(|layer| layer.slices.as_mut()) {
            pool.install(|| slices.prepare(view, removed, c_arm))?;
        }
        if self.standing.is_none() {
            self.standing = Some(CachedView::written_to(&self.grid, c_arm, with_bone));
        }
        self.exposure.prepare(c_arm.pixels());
        Ok(())
    }

    /// The parameters.
    pub fn parameters(&self) -> &DrrParameters {
        &self.parameters
    }

    /// The voxels removed so far.
    pub fn removed(&self) -> &RemovedVoxels {
        &self.removed
    }

    /// Line integrals of the anatomy in the last frame, row-major; empty before the first.
    pub fn anatomy(&self) -> &[f64] {
        self.standing.as_ref().map_or(&[], |s| &s.anatomy)
    }

    /// Attenuation (-ln of the transmission) of anatomy, tool, arm and objects in the last frame, row-major;
    /// empty before the first.
    pub fn line_integrals(&self) -> Vec<f64> {
        let metal = Metal { tool: &self.tool, solids: &self.solids };
        let attenuation =
            |s: &CachedView| self.exposure.attenuations(s.images(), metal, s.c_arm.columns as usize);
        self.standing.as_ref().map_or(Vec::new(), attenuation)
    }

    /// Removes voxels by linear index; ignores those already removed. Returns the number of newly removed
    /// voxels. Order and grouping into batches do not affect the result.
    ///
    /// # Errors
    /// The view has another grid, or an index is outside the volume; then the whole batch is refused.
    pub fn remove(&mut self, view: &VolumeView<'_>, batch: &[u32]) -> Result<usize, DrrError> {
        self.check_view(view)?;
        self.removed.check(batch)?;
        let traced = self.standing.as_mut().filter(|s| s.traced && !s.anatomy.is_empty());
        let mut marker = traced.map(|s| DirtyMarker::new(s, &self.grid, self.parameters.projector));
        let mut labelled = self.labelled.as_mut().map(|labelled| labelled.marker(&self.grid));
        let mut new = 0;
        for &index in batch {
            let linear = index as usize;
            if !self.removed.insert(linear) {
                continue;
            }
            new += 1;
            let voxel = self.grid.voxel_of(linear);
            let hu = view.hu().get(linear).copied().unwrap_or(self.parameters.fill_hu);
            let mut changed = self.tissue.remove(view, linear, voxel, hu)?;
            if let Some(bone) = &mut self.bone {
                changed |= bone.remove(view, linear, voxel, hu)?;
            }
            let centre_m = || self.grid.index_to_world(voxel.map(|v| v as f64));
            if let Some(marker) = marker.as_mut().filter(|_| changed) {
                marker.mark(centre_m());
            }
            // The length of bone and tunnel changes even where the attenuation does not.
            if let Some(marker) = &mut labelled {
                marker.mark(centre_m());
            }
        }
        Ok(new)
    }

    /// Restores all removed voxels; the next frame is rendered in full.
    ///
    /// # Errors
    /// The view has another grid.
    pub fn restore_all(&mut self, view: &VolumeView<'_>) -> Result<(), DrrError> {
        self.check_view(view)?;
        self.removed.clear();
        for layer in core::iter::once(&mut self.tissue).chain(&mut self.bone) {
            layer.restore(view);
        }
        self.standing = None;
        self.labelled = None;
        Ok(())
    }

    /// Renders a frame into `image` (rows from top to bottom, one u16 per pixel).
    ///
    /// # Errors
    /// The view has another grid, the C-arm or tool is invalid, or the image has the wrong size. The cache
    /// remains valid.
    pub fn render(
        &mut self,
        view: &VolumeView<'_>,
        c_arm: &CArm,
        tool: &Tool,
        seed: FrameSeed,
        image: &mut [u16],
    ) -> Result<FrameReport, DrrError> {
        self.render_to(view, c_arm, tool, seed, Output::Mono16(image))
    }

    /// Same as [`DrrRenderer::render`], for any pixel type.
    ///
    /// # Errors
    /// As [`DrrRenderer::render`].
    pub fn render_to(
        &mut self,
        view: &VolumeView<'_>,
        c_arm: &CArm,
        tool: &Tool,
        seed: FrameSeed,
        mut output: Output<'_>,
    ) -> Result<FrameReport, DrrError> {
        self.check_view(view)?;
        output.check(c_arm)?;
        self.tool.place(tool, c_arm, self.parameters.energy_kev)?;
        let mut standing = match self.standing.take() {
            Some(s) if s.c_arm == *c_arm => s,
            Some(s) => s.of_another(&self.grid, c_arm),
            None => CachedView::new(&self.grid, c_arm),
        };
        let LayerWork { kind, pixels: rays_traced } = self.update_anatomy(view, &mut standing)?;
        let width = standing.c_arm.columns as usize;
        let removed = self.removed.count();
        // Voxels outside the frame scatter into it.
        let is_stale = standing.scatter.as_ref().is_none_or(|scatter| scatter.removed != removed);
        let stage = self.scatter.as_ref().filter(|_| kind != RenderKind::Cached || is_stale);
        if let Some(stage) = stage {
            let (anatomy, table) = (standing.images(), self.exposure.spectrum());
            let image = || stage.image(view, &self.removed, c_arm, anatomy, table);
            standing.scatter = Some(self.pool.install(image)?);
        }
        if kind != RenderKind::Cached || stage.is_some() {
            let window = self.parameters.display.window;
            let images = standing.images();
            standing.window = self.exposure.with_anatomy(images, width, |a| window_limits(window, a));
        }
        let tissue = self.tissue.field(view, &self.removed);
        let bone = self.bone.as_ref().map(|layer| layer.field(view, &self.removed));
        let anatomy =
            DisplacedAnatomy { projector: self.parameters.projector, tissue: &tissue, bone: bone.as_ref() };
        let (placed, solids, exposure) = (&mut self.tool, &mut self.solids, &mut self.exposure);
        let energy_kev = self.parameters.energy_kev;
        let tool_pixels = self.pool.install(|| {
            solids.draw(tool, c_arm, &standing.fan, energy_kev)?;
            let covered = placed.draw(&standing.fan, &anatomy);
            let metal = Metal { tool: placed, solids };
            exposure.expose(standing.images(), metal, width, standing.window, seed, &mut output);
            Ok::<_, DrrError>(covered)
        })?;
        let window = standing.window;
        self.standing = Some(standing);
        Ok(FrameReport { kind, rays_traced, tool_pixels, window })
    }

    /// Same as [`DrrRenderer::render`], for a C-arm used for one frame only. Keeps the cache of the
    /// stationary C-arm, so that its next frame costs no more than without this one.
    ///
    /// # Errors
    /// As [`DrrRenderer::render`].
    pub fn render_aside(
        &mut self,
        view: &VolumeView<'_>,
        c_arm: &CArm,
        tool: &Tool,
        seed: FrameSeed,
        image: &mut [u16],
    ) -> Result<FrameReport, DrrError> {
        if self.standing.as_ref().is_some_and(|standing| standing.c_arm == *c_arm) {
            return self.render(view, c_arm, tool, seed, image);
        }
        core::mem::swap(&mut self.standing, &mut self.aside);
        self.layers_slices().for_each(SliceOrdered::step_aside);
        let report = self.render(view, c_arm, tool, seed, image);
        self.layers_slices().for_each(SliceOrdered::step_back);
        core::mem::swap(&mut self.standing, &mut self.aside);
        // Its image will miss voxels removed from now on. With zero columns it matches no C-arm.
        if let Some(aside) = &mut self.aside {
            aside.c_arm.columns = 0;
        }
        report
    }

    fn layers_slices(&mut self) -> impl Iterator<Item = &mut SliceOrdered> {
        core::iter::once(&mut self.tissue).chain(&mut self.bone).filter_map(|layer| layer.slices.as_mut())
    }

    fn check_view(&self, view: &VolumeView<'_>) -> Result<(), DrrError> {
        if *view.grid() == self.grid { Ok(()) } else { Err(DrrError::GridChanged) }
    }

    /// Updates the anatomy's line integrals.
    fn update_anatomy(
        &mut self,
        view: &VolumeView<'_>,
        standing: &mut CachedView,
    ) -> Result<LayerWork, DrrError> {
        let fresh = standing.anatomy.is_empty();
        if fresh || !standing.traced {
            let Self { tissue, bone, removed, pool, .. } = self;
            let c_arm = &standing.c_arm;
            let first = tissue.project(view, removed, c_arm, &mut standing.anatomy, pool)?;
            if let Some(mut done) = first {
                if let Some(bone) = bone {
                    let second = bone.project(view, removed, c_arm, &mut standing.bone_m, pool)?;
                    done = second.map_or(done, |second| done.or_more(second));
                }
                standing.traced = false;
                return Ok(done);
            }
        }
        Ok(self.trace_anatomy(view, standing))
    }
}
