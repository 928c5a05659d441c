//! Drilling: a burr's cutting energy goes into the voxels that it presses on, and a voxel ends when its energy is spent.
//!
//! **Energy.** In a tick the burr (radius r, speed omega, normal contact force F) cuts with
//! `E = mu_cut F (omega 2r/3) dt` (Preston 1927: wear in proportion to pressure times sliding speed; 2r/3 is the mean
//! distance from the spin axis over the front half of the ball, weighted by projected area).
//!
//! **Who gets it.** Voxels whose surface (the measure of [`super::query`]) lies within the burr grown by `reach_m` share it
//! by pressure times area, the pressure in proportion to the depth (an elastic foundation of thickness `reach_m`): weight =
//! volume x min(depth / width, 1). So soft bone recedes until the hard bone beside it carries the load.
//!
//! **What a voxel can take.** Its energy is `u(HU) x volume`. It loses at most the part that lies within the grown burr, and
//! recedes no faster than `feed_per_revolution_max_m` a revolution. What a full voxel cannot take goes to the others; what
//! nobody can take is reported (it heats).
//!
//! So the removed volume is E / u, and the depth does not depend on voxel size or dt. Weights and shares do not depend on
//! the order of the voxels; the order of summation is fixed, for bit-exact replay.
//!
//! **Slivers.** Beside the path, voxels are cut in part. Once the burr has withdrawn from a voxel by `reach_m`, what is left
//! of it falls off if less than `sliver_fraction` remains: the hole in the voxels has on average the burr's size.

use nalgebra::Vector3;

use super::BoneError;
use super::field::{BoneField, BoneParameters, check_volume};
use super::grid::GridGeometry;
use super::reach::Reach;
use super::removal::Removal;
use super::strength::{NO_PLACE, block_of};

/// Rounds of sharing the energy; what remains after them is reported as unused.
const SHARE_ROUNDS: usize = 8;
/// Sums run side by side, in a fixed order.
const LANES: usize = 4;

/// How a burr turns force and speed into cutting energy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CuttingLaw {
    /// Ratio of cutting power to normal force times sliding speed, mu_cut. No table for bone was found; 0.3 is an assumption.
    pub cutting_friction: f64,
    /// How far beyond its surface the burr cuts, in metres: compliance of the contact and run-out of the tool. The hole's
    /// radius is the burr's plus this.
    pub reach_m: f64,
    /// Greatest feed a revolution in metres: depth of the teeth.
    pub feed_per_revolution_max_m: f64,
    /// Voxels beside the path fall off when less than this fraction is left; 0 keeps them.
    pub sliver_fraction: f64,
}

impl Default for CuttingLaw {
    fn default() -> Self {
        Self {
            cutting_friction: 0.3,
            reach_m: 1.0e-4,
            feed_per_revolution_max_m: 2.0e-4,
            sliver_fraction: 0.5,
        }
    }
}

impl CuttingLaw {
    /// Cutting power in W of a burr: see the module.
    pub fn power_w(&self, burr: &BurrState) -> f64 {
        self.cutting_friction * burr.normal_force_n * burr.speed_rad_s.abs() * burr.radius_m * (2.0 / 3.0)
    }

    /// Steady feed in m/s of a burr under its force in bone of the given specific cutting energy, below the feed limit:
    /// power / (u x cross-section of the hole). For calibration.
    pub fn steady_feed_m_s(&self, burr: &BurrState, specific_energy_j_m3: f64) -> f64 {
        let hole = burr.radius_m + self.reach_m;
        self.power_w(burr) / (specific_energy_j_m3 * core::f64::consts::PI * hole * hole)
    }

    pub(super) fn check(&self) -> Result<(), BoneError> {
        let above_zero = [
            ("cutting_friction", self.cutting_friction),
            ("reach_m", self.reach_m),
            ("feed_per_revolution_max_m", self.feed_per_revolution_max_m),
        ];
        for (name, value) in above_zero {
            if !(value.is_finite() && value > 0.0) {
                return Err(BoneError::Parameter { name, value, expected: "a finite number above 0" });
            }
        }
        let value = self.sliver_fraction;
        if !(0.0..=1.0).contains(&value) {
            return Err(BoneError::Parameter { name: "sliver_fraction", value, expected: "0 to 1" });
        }
        Ok(())
    }
}

/// A spinning ball burr in contact.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BurrState {
    /// Centre in the world, metres.
    pub centre_m: Vector3<f64>,
    /// Radius in metres.
    pub radius_m: f64,
    /// Spin in rad/s; the sign does not matter.
    pub speed_rad_s: f64,
    /// Sum of the normal contact forces on the burr in N.
    pub normal_force_n: f64,
}

/// What one tick of drilling did.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct GrindReport {
    /// Voxels removed in this tick.
    pub removed_count: usize,
    /// Voxels whose energy is spent and that wait for room in the next tick's list.
    pub waiting_count: usize,
    /// Voxels that took energy.
    pub cut_count: usize,
    /// Voxels in reach that could take nothing because the pool of blocks is full.
    pub refused_count: usize,
    /// Cutting energy of the tick in J.
    pub energy_offered_j: f64,
    /// Part of it that went into bone.
    pub energy_used_j: f64,
    /// Energy in J that slivers would still have needed when they fell off; not taken from the burr.
    pub energy_shed_j: f64,
}

/// A voxel in reach of the burr.
#[derive(Debug, Clone, Copy)]
pub(super) struct Share {
    pub index: u32,
    pub place: usize,
    /// Depth of the voxel in the burr as a fraction of its width, times its volume.
    pub weight: f64,
    /// Fraction of its energy that is spent.
    spent: f64,
    /// Energy of the whole voxel.
    full_j: f64,
}

/// Working memory of [`BoneField::grind`], reserved for the largest burr.
#[derive(Debug, Clone)]
pub(super) struct DrillScratch {
    pub(super) shares: Vec<Share>,
    /// Weights of the shares and what each can take in this tick, J; then zeros up to a multiple of [`LANES`].
    weight: Vec<f64>,
    room_j: Vec<f64>,
    capacity: usize,
}

impl DrillScratch {
    /// Room for every voxel that the largest burr can reach.
    pub fn new(geometry: &GridGeometry, parameters: &BoneParameters) -> Result<Self, BoneError> {
        let value = parameters.max_burr_radius_m;
        if !(value.is_finite() && value > 0.0) {
            return Err(BoneError::Parameter {
                name: "max_burr_radius_m",
                value,
                expected: "a finite number above 0",
            });
        }
        let capacity = voxels_in_cube(geometry, value + parameters.cutting.reach_m);
        let numbers = || Vec::with_capacity(capacity.next_multiple_of(LANES));
        Ok(Self { shares: Vec::with_capacity(capacity), weight: numbers(), room_j: numbers(), capacity })
    }

    fn clear(&mut self) {
        self.shares.clear();
        self.weight.clear();
        self.room_j.clear();
    }

    fn push(&mut self, share: Share, room_j: f64) {
        self.weight.push(share.weight);
        self.room_j.push(room_j);
        self.shares.push(share);
    }

    /// What all take at `level_j`, the energy a unit of weight is offered, and the weight of those that could take more.
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

    /// What a share takes at a level.
    fn given_j(&self, place: usize, level_j: f64) -> f64 {
        (level_j * self.weight[place]).min(self.room_j[place])
    }

    pub fn capacity(&self) -> usize {
        self.capacity
    }
}

/// Most voxels that a cube of half edge `half_m` can meet.
pub(super) fn voxels_in_cube(geometry: &GridGeometry, half_m: f64) -> usize {
    (0..3).fold(1usize, |count, axis| {
        let along = (2.0 * half_m / geometry.spacing_m[axis]) as usize + 2;
        count.saturating_mul(along.min(geometry.dims[axis]))
    })
}

impl BoneField {
    /// One tick of drilling. `hu` is the CT that the field was built from. The removed voxels are then in
    /// [`BoneField::removed_this_tick`]. On an error nothing has changed.
    pub fn grind(&mut self, hu: &[i16], burr: &BurrState, dt_s: f64) -> Result<GrindReport, BoneError> {
        check_volume(&self.geometry, hu)?;
        self.check_burr(burr, dt_s)?;
        let mut report = GrindReport::default();
        self.removed.clear();
        let cutting = self.parameters.cutting;
        report.energy_offered_j = cutting.power_w(burr) * dt_s;
        if report.energy_offered_j > 0.0 {
            self.scratch.clear();
            self.collect(hu, burr, dt_s, &mut report);
            match self.parameters.removal {
                Removal::Energy => {
                    let level_j = self.share(report.energy_offered_j);
                    report.energy_used_j = self.scratch.taken_at(level_j).0;
                    self.apply(level_j, &mut report);
                }
                rule => {
                    report.energy_offered_j = 0.0;
                    self.remove_by_rule(rule, hu, burr.speed_rad_s.abs(), &mut report);
                }
            }
        }
        self.remove_spent(&mut report);
        Ok(report)
    }

    fn check_burr(&self, burr: &BurrState, dt_s: f64) -> Result<(), BoneError> {
        let max_burr_radius_m = self.parameters.max_burr_radius_m;
        let refuse =
            |name, value, expected| Err(BoneError::Burr { name, value, expected, max_burr_radius_m });
        if let Some(value) = burr.centre_m.iter().find(|x| !x.is_finite()) {
            return refuse("centre_m", *value, "finite coordinates");
        }
        if !(burr.radius_m > 0.0 && burr.radius_m <= max_burr_radius_m) {
            return refuse("radius_m", burr.radius_m, "above 0 and not above the largest");
        }
        if !burr.speed_rad_s.is_finite() {
            return refuse("speed_rad_s", burr.speed_rad_s, "a finite number");
        }
        if !(burr.normal_force_n.is_finite() && burr.normal_force_n >= 0.0) {
            return refuse("normal_force_n", burr.normal_force_n, "a finite number of at least 0");
        }
        if !(dt_s.is_finite() && dt_s > 0.0) {
            return refuse("time step", dt_s, "a finite number of seconds above 0");
        }
        Ok(())
    }

    /// Lists the voxels in reach with their weights, and sheds slivers that the burr has left behind.
    fn collect(&mut self, hu: &[i16], burr: &BurrState, dt_s: f64, report: &mut GrindReport) {
        let cutting = self.parameters.cutting;
        let reach = Reach::of_burr(burr.radius_m, &self.geometry, &cutting);
        self.reach(hu, &self.geometry.point_to_grid(&burr.centre_m), &reach);
        let recession =
            cutting.feed_per_revolution_max_m * burr.speed_rad_s.abs() * dt_s / core::f64::consts::TAU;
        let volume = self.geometry.voxel_volume_m3();
        for place in 0..self.reached.kept.len() {
            let voxel = self.reached.kept[place] as usize;
            let (surface, width) = (self.reached.surface[voxel], self.reached.width[voxel]);
            let (spent, full_j) = (self.reached.spent[voxel], self.reached.full_j[voxel]);
            let index = self.reached.index[voxel];
            let Some(place) = self.claim(voxel) else {
                report.refused_count += 1;
                continue;
            };
            let left = 1.0 - spent;
            // Cut or, beyond, a sliver.
            if surface >= reach.cut_m {
                if self.waiting.len() < self.waiting.capacity() {
                    self.pool.set(place, 1.0);
                    self.waiting.push(index);
                    report.energy_shed_j += left * full_j;
                }
            } else if self.scratch.shares.len() < self.scratch.capacity {
                let depth = ((reach.cut_m - surface) / width).min(1.0);
                let advance = (recession / width).min(1.0);
                let room_j = depth.min(left).min(advance) * full_j;
                let weight = depth * volume;
                self.scratch.push(Share { index, place, weight, spent, full_j }, room_j);
            }
        }
    }

    /// Where a voxel in reach keeps its spent fraction, taking a block if needed; `None` if the pool is full.
    fn claim(&mut self, voxel: usize) -> Option<usize> {
        if self.reached.place[voxel] == NO_PLACE {
            let [i, j, k] = self.voxel_of_index(self.reached.index[voxel] as usize);
            let used = self.pool.used();
            self.reached.place[voxel] = self.pool.claim(i, j, k)?;
            if self.pool.used() > used {
                self.tracks.forget_box(&block_of([i, j, k]));
            }
        }
        Some(self.reached.place[voxel])
    }

    /// Shares the energy by weight; what exceeds a voxel's room goes to the others. Returns the energy that a unit of weight is
    /// offered: Newton's steps on the level at which all is taken.
    fn share(&mut self, energy_j: f64) -> f64 {
        let padded = self.scratch.shares.len().next_multiple_of(LANES);
        self.scratch.weight.resize(padded, 0.0);
        self.scratch.room_j.resize(padded, 0.0);
        let mut level_j = 0.0;
        for _ in 0..SHARE_ROUNDS {
            let (taken_j, open) = self.scratch.taken_at(level_j);
            let rest_j = energy_j - taken_j;
            if open <= 0.0 || rest_j <= 0.0 {
                break;
            }
            level_j += rest_j / open;
        }
        level_j
    }

    /// Books the energy and queues the voxels that are spent.
    fn apply(&mut self, level_j: f64, report: &mut GrindReport) {
        for place in 0..self.scratch.shares.len() {
            let share = self.scratch.shares[place];
            let given_j = self.scratch.given_j(place, level_j);
            if given_j <= 0.0 {
                continue;
            }
            report.cut_count += 1;
            let mut spent = (share.spent + given_j / share.full_j).min(1.0);
            // Rounding of spent + (1 - spent): what is nearer to the end than 1e-12 is at the end.
            if spent > 1.0 - 1e-12 {
                if self.waiting.len() < self.waiting.capacity() {
                    spent = 1.0;
                    self.waiting.push(share.index);
                } else {
                    // No room even to wait: it keeps a trace of strength and ends in a later tick.
                    spent = 1.0 - 1e-9;
                }
            }
            self.pool.set(share.place, spent);
        }
    }

    /// Takes spent voxels out of the bone, as many as the tick's list holds.
    fn remove_spent(&mut self, report: &mut GrindReport) {
        let count = self.waiting.len().min(self.parameters.removed_per_tick);
        for place in 0..count {
            let index = self.waiting[place];
            let [i, j, k] = self.voxel_of_index(index as usize);
            self.occupancy.set(i, j, k, false);
            self.tracks
                .forget_near(self.voxel_position([i, j, k].map(|x| x as i64)), self.geometry.spacing_m);
            self.removed.push(index);
        }
        self.waiting.drain(..count);
        self.removed_total += count as u64;
        report.removed_count = count;
        report.waiting_count = self.waiting.len();
    }
}
