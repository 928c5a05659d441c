//! Line integrals ray by ray.

use rayon::prelude::*;

use super::layer::LayerWork;
use super::standing::CachedView;
use super::{DrrRenderer, Projector, RenderKind};
use crate::carm::CArm;
use crate::grid::VolumeView;
use crate::ray::{IndexRay, RayFan};
use crate::removal::AttenuationField;
use crate::{joseph, siddon};

/// Below this number of rays, the calling thread traces them without waking the workers.
const PARALLEL_FROM: usize = 256;

impl DrrRenderer {
    fn trace(&self, field: &AttenuationField<'_>, ray: &IndexRay) -> f64 {
        match self.parameters.projector {
            Projector::Siddon => siddon::line_integral(field, ray, (0.0, 1.0)),
            _ => joseph::line_integral(field, ray),
        }
    }

    /// Updates the anatomy's line integrals.
    pub(super) fn trace_anatomy(&self, view: &VolumeView<'_>, standing: &mut CachedView) -> LayerWork {
        let tissue = self.tissue.field(view, &self.removed);
        let bone = self.bone.as_ref().map(|layer| layer.field(view, &self.removed));
        if standing.anatomy.is_empty() {
            self.trace_all(&tissue, standing.c_arm, &standing.fan, &mut standing.anatomy);
            if let Some(bone) = &bone {
                self.trace_all(bone, standing.c_arm, &standing.fan, &mut standing.bone_m);
            }
            return LayerWork { kind: RenderKind::Full, pixels: standing.anatomy.len() };
        }
        if standing.dirty_list.is_empty() {
            return LayerWork { kind: RenderKind::Cached, pixels: 0 };
        }
        let mut list = core::mem::take(&mut standing.dirty_list);
        // Neighbouring rays in sequence share cache lines; the order does not affect the result.
        list.sort_unstable();
        let (columns, fan) = (standing.c_arm.columns, standing.fan);
        self.trace_list(&tissue, columns, &fan, &list, &mut standing.anatomy);
        if let Some(bone) = &bone {
            self.trace_list(bone, columns, &fan, &list, &mut standing.bone_m);
        }
        for &pixel in &list {
            standing.dirty[pixel as usize] = false;
        }
        let traced = list.len();
        list.clear();
        standing.dirty_list = list;
        LayerWork { kind: RenderKind::Incremental, pixels: traced }
    }

    pub(super) fn trace_all(
        &self,
        field: &AttenuationField<'_>,
        c_arm: CArm,
        fan: &RayFan,
        image: &mut Vec<f64>,
    ) {
        image.resize(c_arm.pixels(), 0.0);
        let rows = image.par_chunks_mut(c_arm.columns as usize).zip(0_u32..c_arm.rows);
        self.pool.install(|| {
            rows.for_each(|(line, row)| {
                for (value, column) in line.iter_mut().zip(0_u32..) {
                    *value = self.trace(field, &fan.index_ray(column, row));
                }
            });
        });
    }

    fn trace_list(
        &self,
        field: &AttenuationField<'_>,
        columns: u32,
        fan: &RayFan,
        list: &[u32],
        image: &mut [f64],
    ) {
        let one = |&pixel: &u32| self.trace(field, &fan.index_ray(pixel % columns, pixel / columns));
        let values: Vec<f64> = if list.len() < PARALLEL_FROM {
            list.iter().map(one).collect()
        } else {
            self.pool.install(|| list.par_iter().with_min_len(64).map(one).collect())
        };
        for (&pixel, value) in list.iter().zip(values) {
            image[pixel as usize] = value;
        }
    }
}
