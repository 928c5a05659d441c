//! A layer: one quantity integrated along rays. Attenuation or, with a spectrum, metres of one tissue type.

use super::{DrrParameters, RenderKind};
use crate::attenuation::MuTable;
use crate::carm::CArm;
use crate::error::DrrError;
use crate::grid::VolumeView;
use crate::machine::Machine;
use crate::removal::{AttenuationField, BlockMap, RemovedVoxels};
use crate::slice_ordered::{SliceOrdered, Update};

/// How much of a layer was computed for a frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct LayerWork {
    pub kind: RenderKind,
    pub pixels: usize,
}

impl LayerWork {
    /// The more complete of the two; `self` if they are equal.
    pub fn or_more(self, other: Self) -> Self {
        if other.pixels > self.pixels { other } else { self }
    }
}

/// The quantity, and the data that speeds up its integration.
pub(super) struct Layer {
    table: MuTable,
    fill_per_m: f64,
    blocks: BlockMap,
    intact_blocks: BlockMap,
    /// The sums over slices, if the projector uses them.
    pub slices: Option<SliceOrdered>,
}

impl Layer {
    pub fn new(
        view: &VolumeView<'_>,
        table: MuTable,
        unit_per_m: f64,
        parameters: &DrrParameters,
        machine: &'static dyn Machine,
    ) -> Result<Self, DrrError> {
        let blocks = BlockMap::new(view, &table);
        let fill_per_m = table.mu_per_m(parameters.fill_hu);
        let slices = match parameters.projector.slice_ordered()? {
            Some(options) => Some(SliceOrdered::new(view, &table, unit_per_m, fill_per_m, options, machine)?),
            None => None,
        };
        Ok(Self { fill_per_m, table, intact_blocks: blocks.clone(), blocks, slices })
    }

    pub fn field<'a>(&'a self, view: &VolumeView<'a>, removed: &'a RemovedVoxels) -> AttenuationField<'a> {
        AttenuationField {
            view: *view,
            removed,
            blocks: &self.blocks,
            table: &self.table,
            fill_mu_per_m: self.fill_per_m,
        }
    }

    /// True if voxels of this value are not empty.
    pub fn attenuates(&self, hu: i16) -> bool {
        self.table.mu_per_m(hu) > 0.0
    }

    /// Removes a voxel; returns true if that changes the quantity there.
    pub fn remove(
        &mut self,
        view: &VolumeView<'_>,
        linear: usize,
        voxel: [usize; 3],
        hu: i16,
    ) -> Result<bool, DrrError> {
        self.blocks.mark_drilled(voxel, self.fill_per_m);
        if let Some(slices) = &mut self.slices {
            slices.remove(view, linear)?;
        }
        Ok(self.table.mu_per_m(hu) != self.fill_per_m)
    }

    /// Restores all voxels.
    pub fn restore(&mut self, view: &VolumeView<'_>) {
        self.blocks.clone_from(&self.intact_blocks);
        if let Some(slices) = &mut self.slices {
            slices.restore_all(view);
        }
    }

    /// Updates `image` by sums over slices; `None`, with nothing written, if the projector traces rays.
    pub fn project(
        &mut self,
        view: &VolumeView<'_>,
        removed: &RemovedVoxels,
        c_arm: &CArm,
        image: &mut Vec<f64>,
        pool: &rayon::ThreadPool,
    ) -> Result<Option<LayerWork>, DrrError> {
        let Some(slices) = &mut self.slices else { return Ok(None) };
        let fresh = image.is_empty();
        image.resize(c_arm.pixels(), 0.0);
        if fresh {
            slices.forget();
        }
        let update = match slices.refresh(c_arm, image) {
            None => pool.install(|| slices.project(view, removed, c_arm, image))?,
            Some(update) => update,
        };
        Ok(Some(match update {
            Update::Full => LayerWork { kind: RenderKind::Full, pixels: c_arm.pixels() },
            Update::Changed(pixels) => LayerWork { kind: RenderKind::Incremental, pixels },
            Update::Unchanged => LayerWork { kind: RenderKind::Cached, pixels: 0 },
        }))
    }
}
