//! Drilling: the burr's cutting energy is distributed over the voxels that it presses on, and their surfaces
//! recede as the energy is spent.
//!
//! **Energy.** In one tick the burr (radius r, speed omega) cuts with `E = mu_cut omega dt x sum of F r_eff`
//! over its contacts with bone, where F is a contact's normal force (Preston 1927: wear is proportional to
//! pressure times sliding speed). The lever arm r_eff is the mean distance from the spin axis over the half
//! of the ball that faces the contact, weighted by projected area: 2r/3 for the end of the burr, 8r/(3 pi)
//! for its side ([`super::cutting::lever_share`]); the pole itself does not move and cuts nothing. Each
//! contact wears by its own pressure, so the forces add up as scalars: a burr pinched between two walls cuts
//! both, although their forces cancel.
//!
//! A cutter of several balls touches bone with parts of each, and its contacts do not reveal which: a contact
//! represents the nearest point of a patch that extends over several balls. The lever arm of a contact is
//! therefore computed from the touched voxels, each of which belongs to the one ball that is deepest in it:
//! the mean distance of their surfaces from the spin axis, weighted by area projected along the contact
//! normal (`patch.rs`). This is the law of the ball applied to the actual patch: 2R/3 for a point that bores
//! its hole, R for a cylinder pressed sideways. No part counts twice, because no voxel and no force does.
//!
//! **Edge.** Blunt edges plough before they cut: only the part of the total force F that exceeds `F_edge =
//! sum of p_e(HU) x area` over the touched voxels (`edge.rs`) cuts, so E is multiplied by `max(1 - F_edge /
//! F, 0)`, and below F_edge nothing is cut at any speed. The split into ploughing and shearing follows
//! measured sawing forces (J. Manuf. Sci. Eng. 143:121009).
//!
//! **Sharing.** The voxels whose surface (as defined in [`super::query`]) lies within the burr grown by
//! `reach_m` share the energy by pressure times area. The pressure is proportional to the depth (an elastic
//! foundation of thickness `reach_m`), so the weight is min(depth / width, 1), because all voxels have the
//! same volume. Soft bone therefore recedes until the hard bone beside it carries the load. All contacts
//! share one energy: a contact's plane represents the nearest point of its patch and jumps from one point to
//! the next, while the depth is measured over the entire patch. If each contact's voxels get the energy of
//! its own force, a straight feed walks 1.6 mm in voxels of 0.06 mm; with one shared energy it walks 0.2 mm.
//! The drawback: when a tool is pressed sideways, part of that energy cuts the bone ahead, until it has
//! receded out of reach.
//!
//! **Within a step.** The energy comes from the forces at the end of the step, and the voxels recede after
//! the step. Within the step, the burr's contacts recede by the same amount
//! ([`crate::contact_plane::RecessionLaw`]); otherwise, each step would meet the bone of the previous step.
//!
//! **Capacity.** A voxel's total energy is `u(HU) x volume`. In one tick it loses at most the part that lies
//! within the grown burr, and recedes by at most `feed_per_revolution_max_m` per revolution. What a voxel
//! cannot absorb goes to the others; what no voxel can absorb is reported as unused (in reality it heats the
//! bone).
//!
//! The removed volume is therefore E / u, and the depth depends neither on voxel size nor on dt. Weights and
//! shares do not depend on the order of the voxels; the order of summation is fixed, for bit-exact replay.
//!
//! **Partly cut voxels.** A voxel beside the path keeps the part that the burr did not reach, so the wall of
//! a hole is where the burr cut it, independent of the grid. Images have only whole voxels: a voxel is *gone*
//! from the image, and in the list of removed voxels, as soon as less than half of it is left (`GONE`). The
//! hole in the voxels then has the burr's size on average.

use nalgebra::Vector3;
use pulp::Arch;
use scene::MAX_CUTTER_BALLS;

use super::BoneError;
use super::cutting::{TickLoads, check_time_step};
use super::patch::Patch;
use super::reach::{BurrPress, PressedBall, ReachedVoxels};
use super::removal::Removal;
use super::strength::PoolIndex;
use super::voxels::{Drilling, Voxels, check_volume};
use super::yielding::{BoneVoxel, CrushReport, FIRST_NEAR, MOST_PLANES};

/// Iterations of the energy sharing; the remainder is reported as unused.
const SHARE_ROUNDS: usize = 8;
/// Number of parallel partial sums, added in a fixed order.
const LANES: usize = 8;

/// Result of one tick of drilling.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GrindReport {
    /// Number of voxels of which less than half is left since this tick.
    pub removed_count: usize,
    /// Number of such voxels that did not fit into this tick's list and wait for the next tick.
    pub waiting_count: usize,
    /// Number of voxels that absorbed energy.
    pub cut_count: usize,
    /// Number of voxels in reach that could not absorb energy because memory ran out.
    pub refused_count: usize,
    /// Force in N below which the burr's edges plough without cutting; 0 without contact force.
    pub edge_force_n: f64,
    /// Recession of the bone at the burr's deepest point per newton above that force, m/N; 0 without contact
    /// force.
    pub recession_m_per_n: f64,
    /// Lever arm in m at which a cutter of several balls cuts; 0 without contact force, and for a ball.
    pub lever_m: f64,
    /// Cutting energy of the tick in J.
    pub energy_offered_j: f64,
    /// Energy that the bone absorbed, J.
    pub energy_used_j: f64,
    /// Bone crushed by the tool's spheres.
    pub crushed: CrushReport,
}

/// Working memory of a tick, sized for the largest burr.
#[derive(Debug, Clone)]
pub(super) struct DrillScratch {
    /// Weights of the voxels that the burr presses on, in order, and their capacities in this tick, J, padded
    /// with zeros to a multiple of [`LANES`]. Other voxels are omitted, so that the sums do not depend on
    /// other nearby voxels.
    weight: Vec<f64>,
    room_j: Vec<f64>,
    count: usize,
    /// The voxels themselves, by index in the list of voxels in reach; for [`super::removal`] only.
    pub(super) kept: Vec<u32>,
    /// Force below which each contact alone cuts nothing, N; for [`super::edge`] only.
    pub(super) edge_n: Vec<f64>,
    /// The patch that a cutter of several balls touches; for [`super::patch`] only.
    pub(super) patch: Vec<Patch>,
}

/// Result of sharing the energy.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Level {
    /// Energy in J offered per unit of weight.
    level_j: f64,
    /// Total energy absorbed, J.
    taken_j: f64,
}

impl DrillScratch {
    /// Creates working memory for `capacity` voxels, touched by one ball or several.
    pub fn new(capacity: usize, is_ball: bool) -> Self {
        let numbers = || vec![0.0; capacity.next_multiple_of(LANES)];
        Self {
            weight: numbers(),
            room_j: numbers(),
            count: 0,
            kept: Vec::with_capacity(capacity),
            edge_n: Vec::with_capacity(MOST_PLANES * MAX_CUTTER_BALLS),
            patch: Vec::with_capacity(if is_ball { 0 } else { capacity }),
        }
    }

    /// Selects the voxels with positive depth.
    fn keep(&mut self, depth: &[f64], room_j: &[f64]) {
        let mut out = self.weight.iter_mut().zip(&mut self.room_j);
        let mut count = 0;
        for (depth, room) in depth.iter().zip(room_j) {
            if *depth > 0.0
                && let Some((weight_out, room_out)) = out.next()
            {
                (*weight_out, *room_out) = (*depth, *room);
                count += 1;
            }
        }
        out.take(LANES - 1).for_each(|(weight, room)| (*weight, *room) = (0.0, 0.0));
        self.count = count;
    }

    /// Distributes the energy by weight; the excess over a voxel's capacity goes to the others.
    fn share(&self, arch: Arch, energy_j: f64) -> Level {
        let padded = self.count.next_multiple_of(LANES);
        arch.dispatch(Share { energy_j, weight: &self.weight[..padded], room_j: &self.room_j[..padded] })
    }
}

/// The loops of [`DrillScratch::share`], compiled for each instruction set; the order of every sum is
/// explicit.
struct Share<'a> {
    energy_j: f64,
    weight: &'a [f64],
    room_j: &'a [f64],
}

impl Share<'_> {
    /// Returns the total energy absorbed at a level, and the weight of the voxels with capacity left.
    #[inline(always)]
    fn taken_at(&self, level_j: f64) -> (f64, f64) {
        let (mut taken, mut open) = ([0.0; LANES], [0.0; LANES]);
        for (weights, rooms) in self.weight.chunks_exact(LANES).zip(self.room_j.chunks_exact(LANES)) {
            for lane in 0..LANES {
                let offered = level_j * weights[lane];
                let is_open = offered < rooms[lane];
                taken[lane] += if is_open { offered } else { rooms[lane] };
                open[lane] += if is_open { weights[lane] } else { 0.0 };
            }
        }
        (taken.iter().sum(), open.iter().sum())
    }
}

impl pulp::WithSimd for Share<'_> {
    type Output = Level;

    /// Finds the level at which all energy is absorbed by Newton's method. The absorbed energy is piecewise
    /// linear in the level, with kinks only where a voxel fills up, so the iteration has converged once a
    /// step leaves the same voxels unfilled.
    #[inline(always)]
    fn with_simd<S: pulp::Simd>(self, _: S) -> Level {
        let mut level_j = 0.0;
        let mut open_before = f64::INFINITY;
        let mut round = 0;
        loop {
            let (taken_j, open) = self.taken_at(level_j);
            let rest_j = self.energy_j - taken_j;
            if open <= 0.0 || rest_j <= 0.0 || open >= open_before || round == SHARE_ROUNDS {
                return Level { level_j, taken_j };
            }
            level_j += rest_j / open;
            open_before = open;
            round += 1;
        }
    }
}

/// Spent fraction above which a voxel is gone from images and from the list of bone.
pub(super) const GONE: f64 = 0.5;

/// Returns whether a voxel is fully spent, to within 1e-12: the rounding of spent + (1 - spent).
pub(super) fn is_ended(spent: f64) -> bool {
    spent > 1.0 - 1e-12
}

/// The drilling cache (the voxels that the burr can reach, see [`super::reach`]) and working memory.
#[derive(Debug)]
pub(super) struct DrillCache {
    reached: ReachedVoxels,
    scratch: DrillScratch,
    /// Working memory: the burr's balls in a tick.
    pressed: Vec<PressedBall>,
    /// Working memory of [`Drilling::indent`].
    crushed: Vec<BoneVoxel>,
    /// Number of voxel edits that `reached` has seen.
    seen: u64,
}

impl DrillCache {
    /// Creates an empty cache for these voxels.
    pub fn new(voxels: &Voxels) -> Self {
        let reached = ReachedVoxels::new(voxels.geometry(), voxels.parameters());
        let is_ball = voxels.parameters().cutter_span_m == 0.0;
        let scratch = DrillScratch::new(reached.capacity(), is_ball);
        Self {
            reached,
            scratch,
            pressed: Vec::with_capacity(MAX_CUTTER_BALLS),
            crushed: Vec::with_capacity(FIRST_NEAR),
            seen: voxels.journal().edits(),
        }
    }

    /// Performs one tick: see [`BoneField::wear`](super::BoneField::wear).
    pub fn wear(
        &mut self,
        voxels: &mut Voxels,
        arch: Arch,
        hu: &[i16],
        work: TickLoads,
        dt_s: f64,
    ) -> Result<GrindReport, BoneError> {
        let TickLoads { burr, contacts, indentations, .. } = work;
        let parameters = *voxels.parameters();
        check_volume(voxels.geometry(), hu)?;
        burr.check(parameters.max_burr_radius_m)?;
        work.check_behind(parameters.max_burr_radius_m, parameters.cutter_span_m)?;
        check_time_step(dt_s, parameters.max_burr_radius_m)?;
        if self.seen != voxels.journal().edits() {
            self.reached.forget();
        }
        let press = BurrPress::new(voxels, &work, dt_s, &mut self.pressed);
        let is_ball = work.behind.is_empty();
        let mut power_w = if is_ball { parameters.cutting.power_of_contacts_w(burr, contacts) } else { 0.0 };
        let mut edit = voxels.drill();
        self.seen = edit.journal().edits();
        let mut report = GrindReport::default();
        for indentation in indentations {
            report.crushed += edit.indent(hu, indentation, &mut self.crushed);
        }
        if report.crushed.crushed_count > 0 {
            self.reached.forget();
        }
        let long_presses = !is_ball && burr.normal_force_n > 0.0;
        if power_w > 0.0 || long_presses {
            self.reached.bring(&edit, arch, hu, &press);
        }
        let mut tick = DrillTick { reached: &mut self.reached, scratch: &mut self.scratch, edit, report };
        if long_presses {
            tick.report.lever_m = tick.lever_m(&press, &work);
            power_w = parameters.cutting.power_at_w(burr, tick.report.lever_m);
        }
        let energy_j = power_w * dt_s;
        if energy_j > 0.0 {
            tick.collect();
            match parameters.removal {
                Removal::Energy => {
                    let has_edge = parameters.material.edge_pressure_ref_pa > 0.0;
                    let edge_n = if has_edge { tick.edge_force_n(hu, &press, contacts) } else { 0.0 };
                    tick.report.edge_force_n = edge_n;
                    tick.report.recession_m_per_n =
                        tick.recession_m_per_j(arch) * (energy_j / burr.normal_force_n);
                    tick.spend(arch, energy_j * (1.0 - edge_n / burr.normal_force_n).max(0.0));
                }
                rule => tick.remove_by_rule(rule, hu, burr.speed_rad_s.abs()),
            }
        }
        Ok(tick.finish())
    }
}

/// A tick of drilling in progress: the voxels in reach, the voxels themselves, and the report so far.
pub(super) struct DrillTick<'t> {
    pub reached: &'t mut ReachedVoxels,
    pub scratch: &'t mut DrillScratch,
    pub edit: Drilling<'t>,
    pub report: GrindReport,
}

impl DrillTick<'_> {
    /// Lists the voxels that the burr presses on.
    fn collect(&mut self) {
        for voxel in 0..self.reached.place.len() {
            if self.reached.place[voxel] == PoolIndex::NONE && self.reached.depth[voxel] > 0.0 {
                match self.edit.claim(self.reached.index[voxel]) {
                    Some(place) => self.reached.place[voxel] = place,
                    None => {
                        self.reached.depth[voxel] = 0.0;
                        self.report.refused_count += 1;
                    }
                }
            }
        }
        self.scratch.keep(&self.reached.depth, &self.reached.room_j);
    }

    /// Returns the recession of the bone at the burr's deepest point per joule, m/J: the voxels share the
    /// energy by depth.
    fn recession_m_per_j(&self, arch: Arch) -> f64 {
        let sum: f64 = self.scratch.weight[..self.scratch.count].iter().fold(0.0, |sum, depth| sum + depth);
        if sum > 0.0 { self.reached.most_recession_m_per_j(arch) / sum } else { 0.0 }
    }

    /// Returns the areas in m^2 of a voxel's faces toward the burr along each grid axis, 0 for a face covered
    /// by other bone; `offset` points from the voxel to the burr.
    pub(super) fn bare_faces_m2(&self, voxel: usize, offset: &Vector3<f64>) -> [f64; 3] {
        let [hx, hy, hz] = self.edit.geometry().spacing_m;
        let mut faces_m2 = [hy * hz, hz * hx, hx * hy];
        for axis in 0..3 {
            let mut beside = self.reached.at[voxel];
            beside[axis] += if offset[axis] >= 0.0 { 1 } else { -1 };
            if self.edit.occupancy().is_solid_at(beside) {
                faces_m2[axis] = 0.0;
            }
        }
        faces_m2
    }

    /// Sets the spent fraction of a voxel in reach that has a place in the pool.
    #[inline]
    pub(super) fn set_spent(&mut self, voxel: usize, spent: f64) {
        let ReachedVoxels { index, at, place, .. } = &*self.reached;
        let set = self.edit.cut(index[voxel], at[voxel], place[voxel], spent);
        self.reached.spent[voxel] = set;
    }

    /// Shares the energy among the voxels, records what they absorb, and queues the spent ones.
    fn spend(&mut self, arch: Arch, energy_j: f64) {
        let level = self.scratch.share(arch, energy_j);
        self.report.energy_offered_j = energy_j;
        self.report.energy_used_j = level.taken_j;
        self.report.cut_count = self.scratch.count;
        self.reached.spend(arch, level.level_j);
        let ReachedVoxels { around, index, place, depth, spent, .. } = &mut *self.reached;
        self.edit.note_cuts(around);
        for (((index, place), depth), spent) in index.iter().zip(place).zip(depth).zip(spent) {
            if *depth > 0.0 {
                *spent = self.edit.set(*index, *place, *spent);
            }
        }
    }

    /// Lists the voxels that are gone, up to the capacity of the tick's list.
    fn finish(mut self) -> GrindReport {
        self.edit.list_queued();
        self.report.removed_count = self.edit.removed_this_tick().len();
        self.report.waiting_count = self.edit.waiting_count();
        self.report
    }
}
