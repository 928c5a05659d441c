//! Renders many frames of one volume. Each thread renders its own frames, so that no thread waits for another
//! between the stages of a frame.
//!
//! The frames share the copies of the volume and the removed voxels. A thread that finds no frame left helps
//! the others with theirs.

use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use super::layer::Layer;
use super::{DrrRenderer, FrameReport, RenderKind};
use crate::carm::CArm;
use crate::detector::FrameSeed;
use crate::display::window_limits;
use crate::error::DrrError;
use crate::exposure::{Anatomy, Exposure, Metal, Output};
use crate::grid::VolumeView;
use crate::ray::RayFan;
use crate::slice_ordered::Images;
use crate::solids::Solids;
use crate::tool::Tool;
use crate::tool_layer::{DisplacedAnatomy, PlacedTool};

/// One frame of a batch.
#[derive(Debug)]
pub struct Shot<'a> {
    /// The C-arm.
    pub c_arm: CArm,
    /// The tool.
    pub tool: &'a Tool,
    /// Seed of the noise.
    pub seed: FrameSeed,
    /// Destination of the pixels.
    pub output: Output<'a>,
}

impl Shot<'_> {
    fn check(&self) -> Result<(), DrrError> {
        self.output.check(&self.c_arm)?;
        self.tool.prepared().try_for_each(|part| part.map(drop))
    }
}

/// Memory of the frame that a thread is rendering, reused for its next.
pub(super) struct Lane {
    images: Images,
    anatomy: Vec<f64>,
    bone_m: Vec<f64>,
    tool: PlacedTool,
    solids: Solids,
    exposure: Exposure,
}

impl DrrRenderer {
    /// Renders a frame of each C-arm for the current voxels, bit-identical to [`DrrRenderer::render_to`]. On
    /// several threads this is faster than one frame after the other. Every frame is computed in full; the
    /// cache of the stationary C-arm is kept.
    ///
    /// # Errors
    /// As [`DrrRenderer::render_to`], with the number of the frame; nothing is rendered in that case. Each
    /// thread needs the memory of one frame.
    pub fn render_batch(
        &mut self,
        view: &VolumeView<'_>,
        shots: &mut [Shot<'_>],
    ) -> Result<Vec<FrameReport>, DrrError> {
        self.check_view(view)?;
        for (frame, shot) in shots.iter().enumerate() {
            shot.check().map_err(|cause| DrrError::Frame { frame, cause: Box::new(cause) })?;
        }
        self.make_ready(view, shots)?;
        let mut lanes = core::mem::take(&mut self.lanes);
        lanes.resize_with(self.parameters.threads, || Mutex::new(self.lane()));
        let mut reports = vec![Ok(FrameReport::NONE); shots.len()];
        let queue = Mutex::new(shots.iter_mut().zip(&mut reports));
        let this: &Self = self;
        // Each thread takes frames until none is left, and only then helps with parts of other threads'
        // frames.
        self.pool.broadcast(|thread| {
            let Some(lane) = lanes.get(thread.index()) else { return };
            let mut lane = lane.lock().unwrap_or_else(PoisonError::into_inner);
            loop {
                let next = queue.lock().unwrap_or_else(PoisonError::into_inner).next();
                let Some((shot, report)) = next else { break };
                *report = this.render_in(&mut lane, view, shot);
            }
        });
        self.lanes = lanes;
        reports.into_iter().collect()
    }

    fn lane(&self) -> Lane {
        Lane {
            images: Images::default(),
            anatomy: Vec::new(),
            bone_m: Vec::new(),
            tool: PlacedTool::default(),
            solids: Solids::default(),
            exposure: self.exposure.anew(),
        }
    }

    /// Creates the copies that the C-arms need.
    fn make_ready(&mut self, view: &VolumeView<'_>, shots: &[Shot<'_>]) -> Result<(), DrrError> {
        let Self { tissue, bone, removed, pool, parameters, .. } = self;
        for slices in core::iter::once(tissue).chain(bone).filter_map(|layer| layer.slices.as_mut()) {
            let c_arms = shots.par_iter().map(|shot| &shot.c_arm);
            pool.install(|| slices.ready(view, removed, c_arms, parameters.threads))?;
        }
        Ok(())
    }

    fn render_in(
        &self,
        lane: &mut Lane,
        view: &VolumeView<'_>,
        shot: &mut Shot<'_>,
    ) -> Result<FrameReport, DrrError> {
        let (c_arm, width) = (&shot.c_arm, shot.c_arm.columns as usize);
        let fan = RayFan::new(&self.grid, c_arm);
        let Lane { images, anatomy, bone_m, tool, solids, exposure } = lane;
        tool.place(shot.tool, c_arm, self.parameters.energy_kev)?;
        self.anatomy_once(&self.tissue, view, c_arm, &fan, images, anatomy);
        if let Some(bone) = &self.bone {
            self.anatomy_once(bone, view, c_arm, &fan, images, bone_m);
        }
        let anatomy = Anatomy { total: anatomy, bone_m, scatter: None };
        let stage = self.scatter.as_ref();
        let scatter = stage.map(|s| s.image(view, &self.removed, c_arm, anatomy, exposure.spectrum()));
        let scatter = scatter.transpose()?;
        let anatomy = Anatomy { scatter: scatter.as_ref(), ..anatomy };
        let window = self.parameters.display.window;
        let window = exposure.with_anatomy(anatomy, width, |image| window_limits(window, image));
        let tissue = self.tissue.field(view, &self.removed);
        let bone = self.bone.as_ref().map(|layer| layer.field(view, &self.removed));
        solids.draw(shot.tool, c_arm, &fan, self.parameters.energy_kev)?;
        let projector = self.parameters.projector;
        let tool_pixels =
            tool.draw(&fan, &DisplacedAnatomy { projector, tissue: &tissue, bone: bone.as_ref() });
        let metal = Metal { tool, solids };
        exposure.expose(anatomy, metal, width, window, shot.seed, &mut shot.output);
        Ok(FrameReport { kind: RenderKind::Full, rays_traced: c_arm.pixels(), tool_pixels, window })
    }

    /// Computes the line integrals of a layer.
    fn anatomy_once(
        &self,
        layer: &Layer,
        view: &VolumeView<'_>,
        c_arm: &CArm,
        fan: &RayFan,
        images: &mut Images,
        out: &mut Vec<f64>,
    ) {
        match &layer.slices {
            Some(slices) => {
                out.resize(c_arm.pixels(), 0.0);
                slices.project_once(c_arm, images, out);
            }
            None => self.trace_all(&layer.field(view, &self.removed), *c_arm, fan, out),
        }
    }
}
