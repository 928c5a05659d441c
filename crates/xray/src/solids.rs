//! Path length of rays in closed meshes, for all pixels at once.
//!
//! A ray is inside a closed mesh from each triangle through which it enters to the one through which it
//! leaves, so its path length is the sum of the distances to the triangles that it crosses, negated where it
//! enters. Distances are clamped to the detector and to 0 at the source, which clips meshes around either.
//! The triangles are projected and filled row by row.
//!
//! **No pixel leaks.** A row crosses an edge if it is at or above the edge's lower end and below its upper
//! one, and the crossing is computed from the lower end to the upper one. So both triangles of an edge get
//! the same bits, and exactly one edge of a triangle is crossed upward and one downward, or none. A triangle
//! covers the half-open range of columns between its crossings. In a closed mesh the starts and ends in a row
//! therefore come in pairs, and in every pixel as many triangles are entered as left, whatever the rounding.

use std::sync::Arc;

use messages::Pose;
use rayon::prelude::*;
use scene::closed_mesh::ClosedMesh;

use crate::attenuation::Material;
use crate::buckets::sort_into_buckets;
use crate::carm::{CArm, Pinhole};
use crate::error::{DrrError, check_range};
use crate::placement::Placement;
use crate::ray::RayFan;
use crate::tool::Tool;
use crate::vector::{Vec3, add_scaled, cross, dot, scale, sub};

/// Near clipping distance from the source's plane, m.
const NEAREST_M: f64 = 1e-6;
/// Rows that one thread fills at a time.
const BAND: usize = 8;

/// Solids whose mass is one material spread evenly over the enclosed volume. Where two overlap, both
/// attenuate.
#[derive(Debug, Clone, PartialEq)]
pub struct PlacedSolids {
    /// The solids, each in its own frame, m.
    pub(crate) solids: Arc<[ClosedMesh]>,
    /// World pose of each solid.
    pub(crate) places: Vec<Placement>,
    pub(crate) material: Material,
    /// Mass per enclosed volume.
    pub(crate) density_g_per_cm3: f64,
}

impl PlacedSolids {
    /// Creates placed solids of aluminium from meshes in metres, their world poses and their density.
    ///
    /// # Errors
    /// The number of poses differs from that of solids, the density is outside 0.001 to 2.7 g/cm³, a
    /// coordinate is not finite or beyond 100 m, or an orientation is not a unit quaternion.
    pub fn new(
        solids: Arc<[ClosedMesh]>,
        t_world_solid: &[Pose],
        density_g_per_cm3: f64,
    ) -> Result<Self, DrrError> {
        if t_world_solid.len() != solids.len() {
            let (given, expected) = (t_world_solid.len(), solids.len());
            return Err(DrrError::Length { field: "t_world_solid", given, expected });
        }
        check_range("density_g_per_cm3", density_g_per_cm3, 1e-3, 2.7, "0.001 to 2.7 g/cm3")?;
        let corners = solids.iter().flat_map(|solid| solid.corners()).flatten();
        for x in corners.chain(t_world_solid.iter().flat_map(|pose| &pose.position_m)) {
            check_range("coordinate of a solid, m", *x, -100.0, 100.0, "-100 to 100 m")?;
        }
        for pose in t_world_solid {
            let size = pose.orientation_xyzw.iter().map(|x| x * x).sum::<f64>();
            check_range("squared size of a quaternion", size, 1.0 - 1e-6, 1.0 + 1e-6, "a unit quaternion")?;
        }
        let places = t_world_solid.iter().map(Placement::of_pose).collect();
        Ok(Self { solids, places, material: Material::Aluminium, density_g_per_cm3 })
    }
}

/// The arm and the meshes among the objects. Reused from frame to frame.
#[derive(Debug, Default)]
pub(crate) struct Solids {
    /// The arm's layer, then one for each material of the objects.
    layers: Vec<SolidLayer>,
}

/// What one layer adds to a piece of a row.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SolidRow<'a> {
    /// [`Material::index`].
    pub(crate) material: usize,
    /// Attenuation of the material at the frame's energy.
    pub(crate) mu_per_m: f64,
    /// Metres of the material in each pixel.
    pub(crate) lengths_m: &'a [f64],
    pub(crate) is_object: bool,
}

impl Solids {
    /// Computes the path lengths on the threads of the current pool.
    ///
    /// # Errors
    /// The energy is outside the range of the attenuation tables.
    pub(crate) fn draw(
        &mut self,
        tool: &Tool,
        c_arm: &CArm,
        fan: &RayFan,
        energy_kev: f64,
    ) -> Result<(), DrrError> {
        let objects = &tool.objects.solids;
        let of = |material: Material| objects.iter().filter(move |placed| placed.material == material);
        let materials = || Material::ALL.into_iter().filter(|material| of(*material).next().is_some());
        self.layers.resize_with(1 + materials().count(), SolidLayer::default);
        self.layers[0].draw(Material::Aluminium, energy_kev, tool.arm.iter(), c_arm, fan)?;
        for (layer, material) in self.layers[1..].iter_mut().zip(materials()) {
            layer.draw(material, energy_kev, of(material), c_arm, fan)?;
        }
        Ok(())
    }

    /// The layers that are in view, in the pixels `from..from + count` of a row.
    #[inline]
    pub(crate) fn rows(&self, row: usize, from: usize, count: usize) -> impl Iterator<Item = SolidRow<'_>> {
        self.layers.iter().enumerate().filter_map(move |(number, layer)| {
            let lengths_m = layer.row(row, from, count)?;
            let (material, mu_per_m) = (layer.material.index(), layer.mu_per_m);
            Some(SolidRow { material, mu_per_m, lengths_m, is_object: number > 0 })
        })
    }
}

/// Metres of one solid material on each ray of a C-arm.
#[derive(Debug)]
struct SolidLayer {
    material: Material,
    /// Attenuation of the material at the frame's energy.
    mu_per_m: f64,
    facets: Vec<Facet>,
    corners: Vec<Vec3>,
    /// Facet indices, sorted by band and otherwise in their original order.
    in_bands: Vec<u32>,
    /// The facets of band i are `starts[i]..starts[i + 1]`.
    starts: Vec<usize>,
    columns: usize,
    /// Row-major; empty where no solid is in view.
    lengths_m: Vec<f64>,
}

impl Default for SolidLayer {
    fn default() -> Self {
        Self {
            material: Material::Aluminium,
            mu_per_m: 0.0,
            facets: Vec::new(),
            corners: Vec::new(),
            in_bands: Vec::new(),
            starts: Vec::new(),
            columns: 0,
            lengths_m: Vec::new(),
        }
    }
}

/// A triangle in the image.
#[derive(Debug, Clone, Copy)]
struct Facet {
    /// Column and row of each corner; pixel centres are at integers.
    corners: [[f64; 2]; 3],
    /// A pixel sees the triangle's plane at depth `distance / (slope . (column, row, 1))`.
    distance: f64,
    slope: Vec3,
    /// Least and greatest corner depth, m, clamped to the detector's.
    depths_m: [f64; 2],
    rows: (u32, u32),
}

/// The C-arm's view of the facets.
struct View {
    pinhole: Pinhole,
    columns: u32,
    rows: u32,
    /// From source to detector along the normal.
    focal_m: f64,
}

impl SolidLayer {
    /// Computes the path lengths in solids of equal material and density.
    fn draw<'a>(
        &mut self,
        material: Material,
        energy_kev: f64,
        placed: impl Iterator<Item = &'a PlacedSolids> + Clone,
        c_arm: &CArm,
        fan: &RayFan,
    ) -> Result<(), DrrError> {
        self.facets.clear();
        self.lengths_m.clear();
        let Some(first) = placed.clone().next() else { return Ok(()) };
        (self.material, self.mu_per_m) = (material, material.mu_per_m(energy_kev)?);
        let pinhole = c_arm.pinhole();
        let [.., focal_m] = pinhole.seen(c_arm.detector_centre_m);
        let view = View { pinhole, columns: c_arm.columns, rows: c_arm.rows, focal_m };
        for placed in placed {
            for (solid, place) in placed.solids.iter().zip(&placed.places) {
                self.add(solid, place, &view);
            }
        }
        if self.facets.is_empty() {
            return Ok(());
        }
        self.columns = view.columns as usize;
        self.sort_into_bands(view.rows as usize);
        self.lengths_m.resize(c_arm.pixels(), 0.0);
        // Seen from the source, the image's winding is reversed if the axes and the normal are left-handed.
        let leaving = if pinhole.is_right_handed() { 1.0 } else { -1.0 };
        let fraction = first.density_g_per_cm3 / material.density_g_per_cm3();
        let mut lengths_m = core::mem::take(&mut self.lengths_m);
        let this: &Self = self;
        lengths_m.par_chunks_mut(BAND * this.columns).enumerate().for_each(|(band, lines)| {
            let facets = &this.in_bands[this.starts[band]..this.starts[band + 1]];
            let rows = lines.chunks_mut(this.columns).zip((band * BAND) as u32..);
            for (line, row) in rows {
                facets.iter().for_each(|facet| this.facets[*facet as usize].fill(row, leaving, line));
                for (sum, column) in line.iter_mut().zip(0_u32..).filter(|(sum, _)| **sum != 0.0) {
                    // A grazing ray can end up slightly negative by rounding.
                    let depth_m = sum.max(0.0) * fraction;
                    *sum = depth_m / view.focal_m * fan.world_ray(column, row).length_m;
                }
            }
        });
        self.lengths_m = lengths_m;
        Ok(())
    }

    /// Metres of the material in the pixels `from..from + count` of a row; `None` if no solid is in view.
    #[inline]
    fn row(&self, row: usize, from: usize, count: usize) -> Option<&[f64]> {
        let start = row * self.columns + from;
        self.lengths_m.get(start..start + count).filter(|values| !values.is_empty())
    }

    /// Adds the facets of a solid, if it is in view.
    fn add(&mut self, solid: &ClosedMesh, place: &Placement, view: &View) {
        let [low, high] = solid.bounds();
        let centre_m = place.point(scale(add_scaled(low, 1.0, high), 0.5));
        let half = scale(sub(high, low), 0.5);
        let half_m = [[half[0], 0.0, 0.0], [0.0, half[1], 0.0], [0.0, 0.0, half[2]]];
        let half_m = half_m.map(|half| place.direction(half));
        if view.pinhole.bounds(centre_m, &half_m, view.columns, view.rows).is_none() {
            return;
        }
        let seen = solid.corners().par_iter().map(|corner| view.pinhole.seen(place.point(*corner)));
        seen.collect_into_vec(&mut self.corners);
        let corners = &self.corners;
        let facets = solid.triangles().par_iter().flat_map_iter(|triangle| {
            let pieces = in_front(triangle.map(|corner| corners[corner as usize]));
            pieces.into_iter().flatten().filter_map(|piece| Facet::new(piece, view))
        });
        self.facets.par_extend(facets);
    }

    /// Sorts the facet indices by band.
    fn sort_into_bands(&mut self, rows: usize) {
        let bands_of = |facet: &Facet| facet.rows.0 as usize / BAND..(facet.rows.1 as usize).div_ceil(BAND);
        let numbered = self.facets.iter().zip(0_u32..);
        let in_bands = numbered.flat_map(|(facet, number)| bands_of(facet).map(move |band| (band, number)));
        sort_into_buckets(in_bands, rows.div_ceil(BAND), &mut self.starts, &mut self.in_bands);
    }
}

/// Clips a triangle, with corners from [`Pinhole::seen`], to the half-space in front of the source.
fn in_front(triangle: [Vec3; 3]) -> [Option<[Vec3; 3]>; 2] {
    let is_in_front = |corner: Vec3| corner[2] >= NEAREST_M;
    match triangle.map(is_in_front) {
        [true, true, true] => [Some(triangle), None],
        [false, false, false] => [None; 2],
        inside => {
            let mut kept = [[0.0; 3]; 4];
            let mut count = 0;
            let mut keep = |corner| {
                kept[count] = corner;
                count += 1;
            };
            for i in 0..3 {
                let next = (i + 1) % 3;
                if inside[i] {
                    keep(triangle[i]);
                }
                if inside[i] != inside[next] {
                    // Start at the corner in front, so that both triangles of an edge get the same point.
                    let (front, behind) = if inside[i] { (i, next) } else { (next, i) };
                    let (front, behind) = (triangle[front], triangle[behind]);
                    let part = (front[2] - NEAREST_M) / (front[2] - behind[2]);
                    let at = add_scaled(front, part, sub(behind, front));
                    keep([at[0], at[1], NEAREST_M]);
                }
            }
            let [a, b, c, d] = kept;
            [Some([a, b, c]), (count == 4).then_some([a, c, d])]
        }
    }
}

impl Facet {
    /// Prepares a triangle in front of the source; `None` if it lies outside the image or crosses no row.
    fn new(seen: [Vec3; 3], view: &View) -> Option<Self> {
        let corners = seen.map(|corner| view.pinhole.pixel(corner));
        let ends = |of: usize| {
            let [a, b, c] = corners.map(|corner| corner[of]);
            [a.min(b).min(c), a.max(b).max(c)]
        };
        let ([left, right], [top, bottom]) = (ends(0), ends(1));
        // `as` saturates, so anything far outside gives an empty range.
        let rows =
            (libm::ceil(top).max(0.0) as u32, libm::ceil(bottom).clamp(0.0, f64::from(view.rows)) as u32);
        // One pixel of margin for rounding of the crossings.
        if rows.0 >= rows.1 || right < -1.0 || left > f64::from(view.columns) {
            return None;
        }
        let normal = cross(sub(seen[1], seen[0]), sub(seen[2], seen[0]));
        let depths = seen.map(|corner| corner[2].min(view.focal_m));
        let depths_m = [depths[0].min(depths[1]).min(depths[2]), depths[0].max(depths[1]).max(depths[2])];
        Some(Self {
            corners,
            distance: dot(normal, seen[0]),
            slope: view.pinhole.slope(normal),
            depths_m,
            rows,
        })
    }

    /// Adds the depths of the columns that the facet covers in a row: with the sign of `leaving` where it is
    /// seen from inside the solid, with the opposite sign otherwise.
    fn fill(&self, row: u32, leaving: f64, line: &mut [f64]) {
        if row < self.rows.0 || row >= self.rows.1 {
            return;
        }
        let row = f64::from(row);
        let (mut upward, mut downward) = (None, None);
        for i in 0..3 {
            let (from, to) = (self.corners[i], self.corners[(i + 1) % 3]);
            if from[1] <= row && row < to[1] {
                upward = Some(crossing(from, to, row));
            } else if to[1] <= row && row < from[1] {
                downward = Some(crossing(to, from, row));
            }
        }
        let (Some(upward), Some(downward)) = (upward, downward) else { return };
        let (start, end, sign) =
            if downward < upward { (downward, upward, leaving) } else { (upward, downward, -leaving) };
        let limit = line.len() as f64;
        let column = |at: f64| libm::ceil(at).clamp(0.0, limit) as usize;
        let (start, end) = (column(start), column(end));
        let in_row = self.slope[1] * row + self.slope[2];
        let [nearest_m, farthest_m] = self.depths_m;
        let covered = line.get_mut(start..end).into_iter().flatten();
        for (sum, column) in covered.zip((start..end).map(|column| column as f64)) {
            let depth_m = self.distance / (self.slope[0] * column + in_row);
            // For a plane seen edge-on, rounding can give any depth or NaN.
            let depth_m = if depth_m >= nearest_m { depth_m.min(farthest_m) } else { nearest_m };
            *sum += sign * depth_m;
        }
    }
}

/// Column at which a row crosses an edge, computed from its lower to its upper end.
fn crossing(lower: [f64; 2], upper: [f64; 2], row: f64) -> f64 {
    lower[0] + (row - lower[1]) * ((upper[0] - lower[0]) / (upper[1] - lower[1]))
}
