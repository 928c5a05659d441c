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
use super::gather::outside;
use super::grid::{GridGeometry, floor_to_i64};
use super::occupancy::{VoxelBox, WINDOW_VOXELS};
use super::query::VoxelSurface;
use super::removal::Removal;

/// Rounds of sharing the energy; what remains after them is reported as unused.
const SHARE_ROUNDS: usize = 8;

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
    /// Energy of the whole voxel.
    full_j: f64,
    /// What it can still take in this tick.
    room_j: f64,
    /// What it has been given.
    given_j: f64,
}

/// Working memory of [`BoneField::grind`], reserved for the largest burr.
#[derive(Debug, Clone)]
pub(super) struct DrillScratch {
    pub(super) shares: Vec<Share>,
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
        let reach = value + parameters.cutting.reach_m;
        let mut capacity = 1usize;
        for axis in 0..3 {
            let along = (2.0 * reach / geometry.spacing_m[axis]) as usize + 2;
            capacity = capacity.saturating_mul(along.min(geometry.dims[axis]));
        }
        Ok(Self { shares: Vec::with_capacity(capacity), capacity })
    }

    pub fn capacity(&self) -> usize {
        self.capacity
    }
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
            self.scratch.shares.clear();
            self.collect(hu, burr, dt_s, &mut report);
            match self.parameters.removal {
                Removal::Energy => {
                    report.energy_used_j = self.share(report.energy_offered_j);
                    self.apply(&mut report);
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
        let centre = self.geometry.point_to_grid(&burr.centre_m);
        let spacing = self.geometry.spacing_m;
        let cutting = self.parameters.cutting;
        let reach = burr.radius_m + cutting.reach_m;
        let diagonal = (spacing[0] * spacing[0] + spacing[1] * spacing[1] + spacing[2] * spacing[2]).sqrt();
        // A sliver's centre is at most half a diagonal inside its receded surface.
        let outer = reach + cutting.reach_m + 0.5 * diagonal;
        let Some(voxels) = self.occupancy.voxels_around(centre.into(), outer, spacing) else {
            return;
        };
        if !self.occupancy.any_in(&voxels) {
            return;
        }
        let recession =
            cutting.feed_per_revolution_max_m * burr.speed_rad_s.abs() * dt_s / core::f64::consts::TAU;
        let VoxelBox { low, high } = voxels;
        // Wider by what rounding can take: the voxel's own distance decides.
        let widest = reach + 1e-6 * diagonal;
        for start in (low[0]..=high[0]).step_by(WINDOW_VOXELS as usize) {
            let place = self.occupancy.window_place(start);
            let count = (high[0] - start + 1).min(WINDOW_VOXELS);
            let wanted = (1u64 << count) - 1;
            for k in low[2]..=high[2] {
                let dz = centre.z - k as f64 * spacing[2];
                for j in low[1]..=high[1] {
                    let dy = centre.y - j as f64 * spacing[1];
                    let room = outer * outer - dz * dz - dy * dy;
                    if room < 0.0 {
                        continue;
                    }
                    let mut bits = self.occupancy.window(place, j as usize, k as usize) & wanted;
                    if bits == 0 {
                        continue;
                    }
                    // Whole bone takes part if its box is in reach; behind it only slivers do, which are cut in part.
                    let (to_y, to_z) = (outside(dy, spacing[1]), outside(dz, spacing[2]));
                    let inner = widest * widest - to_z * to_z - to_y * to_y;
                    let reached = columns_within(centre.x, inner, spacing[0], start);
                    if bits & !reached != 0 {
                        bits &= reached | self.pool.partial_bits(start, count, j as usize, k as usize);
                    }
                    while bits != 0 {
                        let i = start + i64::from(bits.trailing_zeros());
                        bits &= bits - 1;
                        let dx = centre.x - i as f64 * spacing[0];
                        if dx * dx <= room {
                            self.collect_voxel(hu, &centre, [i, j, k], reach, recession, report);
                        }
                    }
                }
            }
        }
    }

    fn collect_voxel(
        &mut self,
        hu: &[i16],
        centre: &Vector3<f64>,
        voxel: [i64; 3],
        reach: f64,
        recession: f64,
        report: &mut GrindReport,
    ) {
        let cutting = self.parameters.cutting;
        let [i, j, k] = voxel.map(|x| x as usize);
        let spent = self.pool.spent(i, j, k);
        let left = 1.0 - spent;
        if left <= 0.0 {
            return;
        }
        let spacing = self.geometry.spacing_m;
        let position = self.voxel_position(voxel);
        let to_box = [0, 1, 2].map(|a| outside(centre[a] - position[a], spacing[a]));
        let VoxelSurface { distance: surface, from_centre, .. } =
            self.voxel_surface(centre, &position, to_box, spent);
        let is_sliver = spent > 0.0 && left < cutting.sliver_fraction && surface > reach + cutting.reach_m;
        if surface >= reach && !is_sliver {
            return;
        }
        let index = self.geometry.linear_index(i, j, k);
        let volume = self.geometry.voxel_volume_m3();
        let full_j = self.cutting_table.specific_energy_j_m3(hu[index]) * volume;
        let Some(place) = self.pool.claim(i, j, k) else {
            report.refused_count += 1;
            return;
        };
        if is_sliver {
            if self.waiting.len() < self.waiting.capacity() {
                self.pool.set(place, 1.0);
                self.waiting.push(index as u32);
                report.energy_shed_j += left * full_j;
            }
            return;
        }
        let length = from_centre.norm();
        // A burr centred on a voxel has all of it in reach, whatever the direction.
        let width = if length > 0.0 { self.width_along(&from_centre, length) } else { spacing[0] };
        let depth = ((reach - surface) / width).min(1.0);
        let advance = (recession / width).min(1.0);
        if self.scratch.shares.len() < self.scratch.capacity {
            let room_j = depth.min(left).min(advance) * full_j;
            let weight = depth * volume;
            self.scratch.shares.push(Share {
                index: index as u32,
                place,
                weight,
                full_j,
                room_j,
                given_j: 0.0,
            });
        }
    }

    /// Shares the energy by weight; what exceeds a voxel's room goes to the others. Returns what was taken.
    fn share(&mut self, energy_j: f64) -> f64 {
        let shares = &mut self.scratch.shares;
        let mut rest = energy_j;
        for _ in 0..SHARE_ROUNDS {
            let open = shares.iter().filter(|s| s.given_j < s.room_j).fold(0.0, |sum, s| sum + s.weight);
            if open <= 0.0 || rest <= 0.0 {
                break;
            }
            let per_weight = rest / open;
            let mut left_over = 0.0;
            for share in shares.iter_mut().filter(|s| s.given_j < s.room_j) {
                let offered = share.weight * per_weight;
                let room = share.room_j - share.given_j;
                if offered >= room {
                    share.given_j = share.room_j;
                    left_over += offered - room;
                } else {
                    share.given_j += offered;
                }
            }
            rest = left_over;
        }
        shares.iter().fold(0.0, |sum, s| sum + s.given_j)
    }

    /// Books the energy and queues the voxels that are spent.
    fn apply(&mut self, report: &mut GrindReport) {
        for place in 0..self.scratch.shares.len() {
            let share = self.scratch.shares[place];
            if share.given_j <= 0.0 {
                continue;
            }
            report.cut_count += 1;
            let mut spent = (self.pool.at(share.place) + share.given_j / share.full_j).min(1.0);
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
            self.tracks.forget_near([i, j, k]);
            self.removed.push(index);
        }
        self.waiting.drain(..count);
        self.removed_total += count as u64;
        report.removed_count = count;
        report.waiting_count = self.waiting.len();
    }
}

/// The voxels of a window that starts at `start` whose slabs along x are within the root of `distance2` of `x`, as bits.
#[inline]
fn columns_within(x: f64, distance2: f64, spacing: f64, start: i64) -> u64 {
    if distance2 <= 0.0 {
        return 0;
    }
    let distance = distance2.sqrt();
    let first = (floor_to_i64((x - distance) / spacing + 0.5) - start).clamp(0, 63);
    let end = (floor_to_i64((x + distance) / spacing + 0.5) + 1 - start).clamp(first, 63);
    (1u64 << end) - (1u64 << first)
}
