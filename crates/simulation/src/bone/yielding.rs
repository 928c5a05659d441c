//! Yielding: bone under a sphere of the tool supports at most its compressive strength.
//!
//! **Strength of a contact.** The bone that a sphere presses on is the bone within [`SHELL_M`] of the nearest
//! surface, as seen from the sphere's centre, on the side of the contact's plane. Its volume divided by the
//! shell's thickness is the footprint, and the contact supports
//!
//! `F_y = sum of strength(HU) x footprint x cos(angle to the plane's normal)`,
//!
//! the projected footprint times the strength (Carter and Hayes 1977 for the strength: see
//! [`MaterialLaw`](super::MaterialLaw)). A contact's footprint grows as the sphere sinks in: F_y of a
//! cylinder of radius r in a flat wall follows the chord, `strength x length x 2 sqrt(2 r d - d^2)` at the
//! depth d. Where the sphere breaks through thin bone, little or no bone is left at its final depth, but the
//! bone on its way had to be crushed: F_y is therefore at least the mean force over the depth d, the energy
//! that the crushed bone absorbs divided by d. The work of a contact at its strength then never falls short
//! of that energy.
//!
//! **Indentation.** A contact at its strength penetrates as far as the tool's step takes it. The overlap that
//! its force does not explain is permanent: every surface on its side recedes to the depth of the deepest, so
//! that the bone takes the sphere's shape. Work and removed bone are consistent, because the volume is the
//! footprint times the depth. Recession is the same as in [`drilling`](super::drilling): a voxel holds a
//! spent fraction, and is removed when fully spent. Crushed bone is thus removed, not compacted: neither
//! contact nor X-ray sees the mass that real bone would keep beside the indentation.
//!
//! A turning burr does not crush: it cuts at any force. The baseline removal rules and ball contacts have no
//! strength ([`Voxels::yields`]).

use nalgebra::{Unit, Vector3};

use super::gather::outside;
use super::grid::VoxelIndex;
use super::occupancy::{VoxelBox, WINDOW_VOXELS};
use super::query::{ContactKind, MAX_PLANES, VoxelEnd};
use super::reach::columns_within;
use super::removal::Removal;
use super::voxels::{Drilling, Voxels};
use crate::contact_plane::ContactPlane;

/// Thickness of the bone that carries a contact, m: the roughness of a crushed or cut surface. A 3 mm sphere
/// that touches a flat wall has a footprint of 0.5 mm2.
pub const SHELL_M: f64 = 50.0e-6;
/// Maximum planes of a sphere: those of four positions.
pub const MOST_PLANES: usize = 4 * MAX_PLANES;
/// Initial capacity of the list of voxels around a sphere.
pub(super) const FIRST_NEAR: usize = 4096;
/// Angle from a plane's normal within which bone belongs to the plane (cosine; 60 degrees), as in the search
/// for planes.
const SIDE_COSINE: f64 = 0.5;

/// A contact loaded to the strength of the bone after the tool's step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Indentation {
    /// Index of the sphere on the tool.
    pub sphere_index: usize,
    /// The sphere's centre, world, m.
    pub centre_m: Vector3<f64>,
    /// Radius of the sphere, m.
    pub radius_m: f64,
    /// Normal from the bone to the sphere, world, unit length.
    pub normal: Unit<Vector3<f64>>,
    /// Depth by which the surface must recede, m.
    pub depth_m: f64,
}

/// Result of the indentations of a tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CrushReport {
    /// Number of voxels whose surface receded.
    pub crushed_count: usize,
    /// Energy that the bone absorbed, J: strength times crushed volume.
    pub energy_j: f64,
    /// Number of voxels that could not recede because memory ran out.
    pub refused_count: usize,
}

impl core::ops::AddAssign for CrushReport {
    fn add_assign(&mut self, other: Self) {
        self.crushed_count += other.crushed_count;
        self.energy_j += other.energy_j;
        self.refused_count += other.refused_count;
    }
}

/// Bone near a sphere's centre.
#[derive(Debug, Clone, Copy)]
pub(super) struct BoneVoxel {
    voxel: VoxelIndex,
    /// Distance from the centre to the voxel's surface, m.
    surface_m: f64,
    /// The voxel's width toward the centre, m.
    width_m: f64,
    /// Direction from the voxel's centre to the sphere's, unit length.
    direction: Vector3<f64>,
    spent: f64,
}

/// Number of vector lanes to which the list of normals is padded.
const LANES: usize = 8;
/// Maximum number of normals of a sphere's planes, padded.
const MOST_NORMALS: usize = MOST_PLANES.next_multiple_of(LANES);

/// Normals of planes in the grid's frame, stored as arrays for branch-free loops over the planes; padded with
/// zeros.
struct Normals {
    along: [[f64; MOST_NORMALS]; 3],
    count: usize,
}

impl Normals {
    fn of<'n>(normals: impl Iterator<Item = &'n Unit<Vector3<f64>>>, voxels: &Voxels) -> Self {
        let mut all = Self { along: [[0.0; MOST_NORMALS]; 3], count: 0 };
        for normal in normals.take(MOST_PLANES) {
            let normal = voxels.in_grid(normal);
            for (along, normal) in all.along.iter_mut().zip(&normal) {
                along[all.count] = *normal;
            }
            all.count += 1;
        }
        all
    }

    /// Returns the plane on whose side the bone in this direction lies, and the cosine between them; the
    /// first one in case of a tie.
    #[inline(always)]
    fn side(&self, direction: &Vector3<f64>) -> Option<(usize, f64)> {
        let count = self.count.next_multiple_of(LANES);
        let [x, y, z] = self.along.each_ref().map(|along| &along[..count]);
        let mut cosines = [0.0; MOST_NORMALS];
        let mut high = [SIDE_COSINE; LANES];
        let lanes = x.chunks_exact(LANES).zip(y.chunks_exact(LANES)).zip(z.chunks_exact(LANES));
        for (((x, y), z), cosines) in lanes.zip(cosines.chunks_exact_mut(LANES)) {
            for lane in 0..LANES {
                let cosine = direction.x * x[lane] + direction.y * y[lane] + direction.z * z[lane];
                cosines[lane] = cosine;
                high[lane] = if cosine > high[lane] { cosine } else { high[lane] };
            }
        }
        let best = high.iter().fold(SIDE_COSINE, |best, cosine| if *cosine > best { *cosine } else { best });
        if best <= SIDE_COSINE {
            return None;
        }
        cosines[..count].iter().position(|cosine| *cosine == best).map(|plane| (plane, best))
    }
}

/// Input of a strength query: the contacts of a sphere.
#[derive(Debug, Clone, Copy)]
pub struct Pressing<'a> {
    /// The sphere's centre after the step, world, m.
    pub centre_m: Vector3<f64>,
    /// The sphere's radius, m.
    pub radius_m: f64,
    /// The sphere's planes, as found by [`Voxels::contact_planes`]; at most [`MOST_PLANES`].
    pub planes: &'a [ContactPlane],
    /// Depth to which the surface on the side of each will have receded, m.
    pub depth_m: [f64; MOST_PLANES],
}

/// Finds the strengths; compiled for each instruction set, with the same bits.
pub(super) struct FindStrengths<'a> {
    pub voxels: &'a Voxels,
    pub hu: &'a [i16],
    pub pressing: &'a Pressing<'a>,
    /// Working memory.
    pub near: &'a mut Vec<BoneVoxel>,
}

impl pulp::WithSimd for FindStrengths<'_> {
    type Output = [f64; MOST_PLANES];

    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> Self::Output {
        self.voxels.strengths_n(self.hu, self.pressing, self.near)
    }
}

impl Voxels {
    /// Returns true if bone yields: it has a finite strength, and no baseline removal rule or contact is
    /// selected.
    pub fn yields(&self) -> bool {
        let parameters = self.parameters();
        parameters.material.strength_ref_pa.is_finite()
            && parameters.removal == Removal::Energy
            && parameters.contact == ContactKind::Planes
    }

    /// Returns the minimum force that any contact with bone supports, N: the weakest bone on the face of one
    /// voxel. A contact that carries less needs no strength.
    pub fn least_strength_n(&self) -> f64 {
        let edge_m = self.geometry().smallest_spacing_m();
        self.material().least_strength_pa() * edge_m * edge_m
    }

    /// Returns the strength of each contact, N. `hu` is the field's CT.
    #[inline(always)]
    fn strengths_n(&self, hu: &[i16], pressing: &Pressing, near: &mut Vec<BoneVoxel>) -> [f64; MOST_PLANES] {
        let normals = Normals::of(pressing.planes.iter().map(|plane| &plane.normal), self);
        let centre = self.geometry().point_to_grid(&pressing.centre_m);
        let (reach_m, depth_m) = (pressing.radius_m + SHELL_M, &pressing.depth_m);
        // Usually sufficient: the surfaces of loaded planes lie within the sphere.
        let listed_m = reach_m + depth_m.iter().fold(0.0, |most: f64, depth| most.max(*depth));
        self.list_near(&centre, listed_m, near);
        let nearest_m = nearest_surfaces(near, reach_m, &normals);
        let end_m: [f64; MOST_PLANES] =
            core::array::from_fn(|plane| nearest_m[plane] + depth_m[plane] + SHELL_M);
        let farthest_m = end_m.iter().filter(|end| end.is_finite()).fold(0.0, |far: f64, end| far.max(*end));
        if farthest_m > listed_m {
            self.list_near(&centre, farthest_m, near);
        }
        let mut strength_n = [0.0; MOST_PLANES];
        let voxel_m3 = self.geometry().voxel_volume_m3();
        for near in near.iter().filter(|near| near.surface_m < farthest_m) {
            let Some((plane, cosine)) = normals.side(&near.direction) else { continue };
            // The part of the voxel's remaining width that is in the shell.
            let far_m = (near.surface_m + (1.0 - near.spent) * near.width_m).min(end_m[plane]);
            let deep_m = far_m - near.surface_m.max(end_m[plane] - SHELL_M);
            if deep_m > 0.0 {
                let share = deep_m / near.width_m;
                let strength_pa = self.material().strength_pa(hu[near.voxel.at()]);
                strength_n[plane] += strength_pa * share * cosine * voxel_m3 / SHELL_M;
            }
        }
        let least_n = self.least_strength_n();
        let voxel_j = |near: &BoneVoxel| self.material().strength_pa(hu[near.voxel.at()]) * voxel_m3;
        for ((plane, strength_n), depth_m) in pressing.planes.iter().zip(&mut strength_n).zip(depth_m) {
            if *depth_m > SHELL_M {
                let normal = self.in_grid(&plane.normal);
                let crushed = recession(near, (pressing.radius_m, *depth_m), &normal);
                let energy_j: f64 = crushed.map(|(near, spent)| voxel_j(near) * (spent - near.spent)).sum();
                *strength_n = strength_n.max(energy_j / depth_m);
            }
            *strength_n = strength_n.max(least_n);
        }
        strength_n
    }

    /// Returns a normal in the grid's frame.
    #[inline(always)]
    fn in_grid(&self, normal: &Unit<Vector3<f64>>) -> Vector3<f64> {
        self.geometry().direction_world_grid.tr_mul(normal.as_ref())
    }

    /// Lists every voxel of bone whose surface lies within `reach_m` of a centre in the grid's metric frame,
    /// in grid order.
    #[inline(always)]
    fn list_near(&self, centre: &Vector3<f64>, reach_m: f64, list: &mut Vec<BoneVoxel>) {
        list.clear();
        let (occupancy, geometry) = (self.occupancy(), self.geometry());
        let spacing = geometry.spacing_m;
        let Some(around) = occupancy.voxels_around((*centre).into(), reach_m, spacing) else { return };
        if !occupancy.any_in(&around) {
            return;
        }
        let VoxelBox { low, high } = around;
        for k in low[2]..=high[2] {
            let to_z = outside(centre.z - k as f64 * spacing[2], spacing[2]);
            for j in low[1]..=high[1] {
                let to_y = outside(centre.y - j as f64 * spacing[1], spacing[1]);
                let room = reach_m * reach_m - to_z * to_z - to_y * to_y;
                for start in (low[0]..=high[0]).step_by(WINDOW_VOXELS as usize) {
                    let window = occupancy.window(occupancy.window_place(start), j as usize, k as usize);
                    let count = (high[0] - start + 1).min(WINDOW_VOXELS);
                    let mut bits =
                        window & ((1u64 << count) - 1) & columns_within(centre.x, room, spacing[0], start);
                    while bits != 0 {
                        let i = start + i64::from(bits.trailing_zeros());
                        bits &= bits - 1;
                        let near = self.near(centre, [i, j, k]);
                        list.extend(near.filter(|near| near.surface_m < reach_m));
                    }
                }
            }
        }
    }

    /// Returns a voxel of bone as seen from a centre; `None` if it is fully spent, or if the centre is the
    /// voxel's.
    #[inline(always)]
    fn near(&self, centre: &Vector3<f64>, voxel: [i64; 3]) -> Option<BoneVoxel> {
        let geometry = self.geometry();
        let position = geometry.voxel_position(voxel);
        let from = [0, 1, 2].map(|axis| centre[axis] - position[axis]);
        let voxel = voxel.map(|x| x as usize);
        let spent = self.pool().spent(voxel[0], voxel[1], voxel[2]);
        let end = VoxelEnd::seen(from, geometry.spacing_m, spent);
        if spent >= 1.0 || end.width <= 0.0 {
            return None;
        }
        let surface_m = end.cut_distance.max(end.box2.sqrt());
        let direction = Vector3::from(from) / end.length2.sqrt();
        Some(BoneVoxel { voxel: geometry.index(voxel), surface_m, width_m: end.width, direction, spent })
    }
}

/// Returns the distance of the nearest surface on the side of each plane, m; infinite if there is none within
/// `reach_m`.
#[inline(always)]
fn nearest_surfaces(near: &[BoneVoxel], reach_m: f64, normals: &Normals) -> [f64; MOST_PLANES] {
    let mut nearest_m = [f64::INFINITY; MOST_PLANES];
    for near in near.iter().filter(|near| near.surface_m < reach_m) {
        if let Some((plane, _)) = normals.side(&near.direction) {
            nearest_m[plane] = nearest_m[plane].min(near.surface_m);
        }
    }
    nearest_m
}

/// Returns the voxels that recede under an indentation of this depth by a sphere of this radius, m, with the
/// fraction of each that is spent afterwards. `near` lists the bone within their sum, `normal` is the plane's
/// in the grid's frame.
#[inline(always)]
fn recession<'n>(
    near: &'n [BoneVoxel],
    (radius_m, depth_m): (f64, f64),
    normal: &Vector3<f64>,
) -> impl Iterator<Item = (&'n BoneVoxel, f64)> {
    let [x, y, z]: [f64; 3] = (*normal).into();
    let is_under = move |near: &BoneVoxel| {
        near.direction.x * x + near.direction.y * y + near.direction.z * z > SIDE_COSINE
    };
    let touched = near.iter().filter(|near| near.surface_m < radius_m && is_under(near));
    let nearest_m = touched.fold(f64::INFINITY, |least: f64, near| least.min(near.surface_m));
    let end_m = if nearest_m.is_finite() { nearest_m + depth_m } else { 0.0 };
    let near = near.iter().filter(move |near| near.surface_m < end_m && is_under(near));
    near.map(move |near| (near, (near.spent + (end_m - near.surface_m) / near.width_m).min(1.0)))
}

impl Drilling<'_> {
    /// Lets the bone under an indentation recede. `near` is working memory.
    pub(super) fn indent(
        &mut self,
        hu: &[i16],
        indentation: &Indentation,
        near: &mut Vec<BoneVoxel>,
    ) -> CrushReport {
        let mut report = CrushReport::default();
        let normal = self.in_grid(&indentation.normal);
        let centre = self.geometry().point_to_grid(&indentation.centre_m);
        let Indentation { radius_m, depth_m, .. } = *indentation;
        self.list_near(&centre, radius_m + depth_m, near);
        let voxel_m3 = self.geometry().voxel_volume_m3();
        for (near, spent) in recession(near, (radius_m, depth_m), &normal) {
            let strength_pa = self.material().strength_pa(hu[near.voxel.at()]);
            if self.crush(near.voxel, spent) {
                report.crushed_count += 1;
                report.energy_j += strength_pa * voxel_m3 * (spent - near.spent);
            } else {
                report.refused_count += 1;
            }
        }
        report
    }
}
