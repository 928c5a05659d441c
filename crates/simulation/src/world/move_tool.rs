//! Steps the tool and free bodies against the contact planes along their entire motion.
//!
//! The strength of yielding bone is computed only where a sphere presses hard enough to matter: with at least
//! the minimum strength of any contact, in the last tick or in this one. A sphere that goes deep within one
//! tick leaves its own footprint: its strength is then the largest on its way; otherwise, a long step would
//! pass through bone. If the attempts end before the assumed strengths hold, the last one does not yield: a
//! tick may stop the tool too early, but never crushes bone with less force than the bone supports. They also
//! end when the tick has cost too much ([`MOST_ITERATIONS`], [`MOST_LISTED`]). An attempt keeps planes and
//! strengths of a sphere that has not moved farther or deeper than in the one before.

use nalgebra::Vector3;

use super::{Bone, Simulation, SimulationError};
use crate::bone::query::MAX_PLANES;
use crate::bone::yielding::{MOST_PLANES, SHELL_M};
use crate::bone::{Indentation, Pressing};
use crate::contact_plane::ContactPlane;
use crate::manipulator::{ContactResult, ManipulatorModel, SphereKind, StepInput, StepReport};
use crate::rigid::ToolDrive;

/// Margin, m: a contact plane of bone takes part in a tick if its gap is within the sphere's travel plus this
/// margin. A larger margin finds more planes around a burr in its own tunnel; with a smaller one, an
/// accelerating tool repeats its step.
const CONTACT_MARGIN_M: f64 = 3.0e-5;
/// Margin for rigid bodies, m.
const BODY_MARGIN_M: f64 = 1.0e-4;

/// Fraction of its strength at which a contact yields, which allows for the solver's rounding.
const AT_STRENGTH: f64 = 1.0 - 1e-9;

/// Motion per tick, m, beyond which a sphere also uses the planes at its destination: from a distance it sees
/// only four.
const JUMP_M: f64 = 1.0e-3;
/// Number of destinations whose planes a sphere uses. With only the last one, a sphere alternated between two
/// positions, each without the planes of the other, and remained in the wall when the attempts ended.
const JUMPS: usize = 3;
/// Planes per sphere: those seen from its start and from its destinations.
pub(super) const PLANES_PER_SPHERE: usize = MOST_PLANES;
const _: () = assert!(PLANES_PER_SPHERE == (1 + JUMPS) * MAX_PLANES, "the planes at every position fit");
/// Largest distance, m, by which a sphere may start behind a plane found at an earlier destination; beyond
/// that, the plane is the back of a plate and is ignored.
const BEHIND_M: f64 = 1.0e-4;
/// Cosine between two planes of a sphere above which the farther one is redundant (5 degrees).
const SAME_COSINE: f64 = 0.996;
/// Maximum attempts to step the tool in a tick, each with planes from farther away or with stronger ones.
const MAX_ATTEMPTS: usize = 16;
/// Iterations of the contact solver, and voxels listed for strengths, in the attempts of a tick beyond which
/// the next attempt is the last. Ticks of drilling stay far below both.
const MOST_ITERATIONS: usize = 512;
const MOST_LISTED: usize = 262_144;
/// Fraction of a sphere's radius that separates the positions at which the strength on its way is evaluated.
/// The bone that a position sees reaches a radius ahead, so a thin wall is seen from at least one.
const SWEEP_SHARE: f64 = 0.5;
/// Factor by which the bone at the final depth must be stronger than assumed for the step to be repeated.
const STRONGER: f64 = 1.05;
/// Maximum search distance for planes, m. A faster tool would move the length of a hip joint in one tick.
const MAX_REACH_M: f64 = 0.05;

/// Start position of a sphere in the tick, and the search distance for its planes.
#[derive(Debug, Clone, Copy)]
pub(super) struct SearchRange {
    /// Start position, world, m.
    pub(super) from_m: Vector3<f64>,
    margin_m: f64,
    /// Whether it presses so hard that its planes get the strength of the bone.
    presses: bool,
    /// Motion in the tick at the end of which that strength is evaluated, m.
    expected_m: Vector3<f64>,
    /// Motions of earlier attempts that led to new planes, m; the oldest is replaced.
    jumps_m: [Vector3<f64>; JUMPS],
    /// Number of such motions so far.
    jump_count: usize,
    /// Whether its planes must be searched, and their strengths computed, in the next attempt.
    is_searched: bool,
    is_weighed: bool,
}

impl SearchRange {
    /// Returns the state of a sphere that has not moved yet.
    pub fn none() -> SearchRange {
        SearchRange {
            from_m: Vector3::zeros(),
            margin_m: 0.0,
            presses: false,
            expected_m: Vector3::zeros(),
            jumps_m: [Vector3::zeros(); JUMPS],
            jump_count: 0,
            is_searched: true,
            is_weighed: true,
        }
    }

    /// Returns the stored motions, and whether each is the latest.
    fn jumps(&self) -> impl Iterator<Item = (&Vector3<f64>, bool)> {
        let last = self.jump_count.saturating_sub(1) % JUMPS;
        let kept = self.jumps_m.iter().take(self.jump_count).enumerate();
        kept.map(move |(place, jump_m)| (jump_m, place == last))
    }

    /// Stores a motion that differs by more than [`JUMP_M`] from the start and from the stored ones; returns
    /// whether it was stored.
    fn note_jump(&mut self, moved_m: &Vector3<f64>) -> bool {
        let is_new =
            moved_m.norm() > JUMP_M && self.jumps().all(|(jump_m, _)| (moved_m - jump_m).norm() > JUMP_M);
        if is_new {
            self.jumps_m[self.jump_count % JUMPS] = *moved_m;
            self.jump_count += 1;
        }
        is_new
    }
}

impl Simulation<'_> {
    /// Returns the work of the last tick's steps of the tool.
    pub fn tool_effort(&self) -> &ToolEffort {
        &self.effort
    }

    /// Steps the tool and free bodies. If a sphere moves farther than its planes were searched for, the step
    /// is repeated with the planes of its entire motion: otherwise, a suddenly pulled tool, whose speed at
    /// the start of the tick predicts nothing, would pass through bone.
    pub(super) fn move_tool(&mut self, drive: &ToolDrive) -> Result<StepReport, SimulationError> {
        for (reach, sphere) in self.reach.iter_mut().zip(self.manipulator.proxy_spheres()) {
            reach.from_m = sphere.centre_m;
            reach.margin_m = CONTACT_MARGIN_M + sphere.velocity_m_per_s.norm() * self.dt_s;
            (reach.presses, reach.expected_m, reach.jump_count) = (false, Vector3::zeros(), 0);
            (reach.is_searched, reach.is_weighed) = (true, true);
        }
        self.effort = ToolEffort::default();
        self.note_pressing();
        self.find_contacts();
        if let Some(rigid) = &mut self.rigid {
            return Ok(rigid.step(&mut self.manipulator, drive, &mut self.planes)?);
        }
        if self.bone.is_some() {
            self.manipulator.save(&mut self.before);
        }
        let ToolDrive { base, tendon, tip_wrench } = *drive;
        let mut attempt = 1;
        loop {
            let input = StepInput { base, tendon, tip_wrench, contacts: &self.planes };
            let report = self.manipulator.step(self.dt_s, &input)?;
            self.effort.attempts += 1;
            self.effort.iterations += report.contact_iterations;
            if attempt == MAX_ATTEMPTS {
                return Ok(report);
            }
            let again = [self.widen_reach(), self.note_pressing(), self.note_depth()];
            if !again.contains(&true) {
                return Ok(report);
            }
            attempt = if self.effort.is_spent() { MAX_ATTEMPTS } else { attempt + 1 };
            self.manipulator.restore(&self.before);
            self.find_contacts();
            if attempt == MAX_ATTEMPTS {
                self.planes.iter_mut().for_each(|plane| plane.strength_n = f64::INFINITY);
            }
        }
    }

    /// Widens the search range of every sphere that moved beyond it, and stores the destinations of those
    /// that jumped. Returns true if there are any and there is bone.
    fn widen_reach(&mut self) -> bool {
        let mut farther = false;
        for (reach, sphere) in self.reach.iter_mut().zip(self.manipulator.proxy_spheres()) {
            let moved_m = sphere.centre_m - reach.from_m;
            if !moved_m.iter().all(|x| x.is_finite()) {
                continue;
            }
            let is_beyond = moved_m.norm() > reach.margin_m;
            if is_beyond {
                reach.margin_m = (moved_m.norm() + CONTACT_MARGIN_M).min(MAX_REACH_M);
            }
            if reach.note_jump(&moved_m) || is_beyond {
                (reach.is_searched, reach.is_weighed, farther) = (true, true, true);
            }
        }
        farther && self.bone.is_some()
    }

    /// Marks the spheres that pressed harder in the last step than the weakest bone supports. Returns true if
    /// there are new ones.
    fn note_pressing(&mut self) -> bool {
        let Some(bone) = &self.bone else { return false };
        let voxels = bone.field.voxels();
        if !voxels.yields() {
            return false;
        }
        let least_n = voxels.least_strength_n();
        let spheres = self.manipulator.proxy_spheres();
        let turns = self.burr_speed_rad_per_s != 0.0;
        let mut any = false;
        for results in self.manipulator.contact_results().chunk_by(|a, b| a.sphere_index == b.sphere_index) {
            let [ContactResult { sphere_index, .. }, ..] = *results else { continue };
            let cuts =
                turns && spheres.get(sphere_index).is_some_and(|sphere| sphere.kind == SphereKind::Burr);
            let Some(reach) = self.reach.get_mut(sphere_index).filter(|reach| !reach.presses && !cuts) else {
                continue;
            };
            let force_n: f64 = results.iter().map(|result| result.normal_force_n).sum();
            reach.presses = force_n > least_n;
            reach.is_weighed |= reach.presses;
            any |= reach.presses;
        }
        any
    }

    /// Updates the expected motion of the spheres that pressed beyond their strength. Returns true if the
    /// bone at their depth supports more than was assumed.
    fn note_depth(&mut self) -> bool {
        self.find_indentations();
        let Some(bone) = &mut self.bone else { return false };
        let mut any = false;
        // The sphere of the last indentation, with its planes and their strengths: a sphere can have as many
        // indentations as planes, and its planes one strength each, which takes most of the time.
        let mut last: Option<(usize, &[ContactPlane], [f64; PLANES_PER_SPHERE])> = None;
        for indentation in self.indentations.iter().filter(|indentation| indentation.depth_m > SHELL_M) {
            let index = indentation.sphere_index;
            let Some(reach) = self.reach.get_mut(index) else { continue };
            let moved_m = indentation.centre_m - reach.from_m;
            let (_, planes, strengths_n) = match last {
                Some(last) if last.0 == index => last,
                _ => {
                    let mut spheres = self.planes.chunk_by(|a, b| a.sphere_index == b.sphere_index);
                    let own = |planes: &&[ContactPlane]| planes[0].sphere_index == index;
                    let planes = spheres.find(own).unwrap_or_default();
                    let way = (&reach.from_m, &moved_m);
                    let radius_m = indentation.radius_m;
                    *last.insert((index, planes, self.effort.strengths_n(bone, radius_m, way, planes)))
                }
            };
            any |= planes.iter().zip(strengths_n).any(|(plane, strength_n)| {
                plane.normal == indentation.normal && strength_n > STRONGER * plane.strength_n
            });
            // Move halfway: the stronger the bone, the less deep the sphere goes.
            reach.expected_m += 0.5 * (moved_m - reach.expected_m);
            reach.is_weighed = true;
        }
        any
    }

    /// Lists where bone was pressed beyond its strength, from the tool's penetration in excess of what its
    /// force explains.
    pub(super) fn find_indentations(&mut self) {
        self.indentations.clear();
        let stiffness_n_per_m = self.manipulator.parameters().contact.stiffness_n_per_m;
        for result in self.manipulator.contact_results() {
            let sphere = self.manipulator.proxy_spheres().get(result.sphere_index);
            let reach = self.reach.get(result.sphere_index);
            let (Some(plane), Some(sphere), Some(reach)) =
                (self.planes.get(result.contact_index), sphere, reach)
            else {
                continue;
            };
            let moved_m = sphere.centre_m - reach.from_m;
            let overlap_m = -(plane.gap_m + plane.normal.dot(&moved_m));
            let depth_m = overlap_m - result.normal_force_n / stiffness_n_per_m;
            if result.normal_force_n >= AT_STRENGTH * plane.strength_n && depth_m > 0.0 {
                self.indentations.push(Indentation {
                    sphere_index: result.sphere_index,
                    centre_m: sphere.centre_m,
                    radius_m: sphere.radius_m,
                    normal: plane.normal,
                    depth_m,
                });
            }
        }
    }

    /// Finds the planes of every sphere. Those of the last attempt must be in `self.planes`, unless every
    /// sphere is searched.
    fn find_contacts(&mut self) {
        if let Some(bone) = &mut self.bone {
            // A full buffer has left out planes that may fit now.
            let searches_all = bone.contacts.dropped() > 0;
            bone.contacts.clear();
            let spheres = self.manipulator.proxy_spheres().iter().zip(&mut self.reach);
            for (index, (sphere, reach)) in spheres.enumerate() {
                if !reach.is_searched && !searches_all {
                    let own = self.planes.iter().filter(|plane| plane.sphere_index == index);
                    own.for_each(|plane| bone.contacts.push(*plane));
                    continue;
                }
                (reach.is_searched, reach.is_weighed) = (false, true);
                self.effort.searches += 1;
                let (centre, radius_m) = (&sphere.centre_m, sphere.radius_m);
                let own = bone.contacts.planes().len();
                bone.field.contact_planes_tracked(
                    index,
                    centre,
                    radius_m,
                    reach.margin_m,
                    &mut bone.contacts,
                );
                for (jump_m, is_last) in reach.jumps() {
                    let (voxels, to_m) = (bone.field.voxels(), centre + jump_m);
                    let first = bone.contacts.planes().len();
                    voxels.contact_planes(index, &to_m, radius_m, CONTACT_MARGIN_M, &mut bone.contacts);
                    for plane in bone.contacts.planes_mut().get_mut(first..).unwrap_or_default() {
                        plane.gap_m -= plane.normal.dot(jump_m);
                    }
                    bone.contacts.keep_from(first, |before, plane| {
                        let same = |other: &ContactPlane| {
                            other.normal.dot(&plane.normal) > SAME_COSINE && other.gap_m <= plane.gap_m
                        };
                        (is_last || plane.gap_m > -BEHIND_M) && !before[own..].iter().any(same)
                    });
                }
            }
            let (speed_rad_per_s, cutting) =
                (self.burr_speed_rad_per_s, &bone.field.voxels().parameters().cutting);
            let most_m = cutting.most_recession_m(speed_rad_per_s, self.dt_s);
            let give = self.receding.give(speed_rad_per_s.abs() * self.dt_s, most_m);
            let spheres = self.manipulator.proxy_spheres();
            for plane in bone.contacts.planes_mut() {
                if spheres[plane.sphere_index].kind == SphereKind::Burr {
                    plane.give = give;
                }
            }
            self.planes.clear();
            self.planes.extend_from_slice(bone.contacts.planes());
            for planes in self.planes.chunk_by_mut(|a, b| a.sphere_index == b.sphere_index) {
                let Some(index) = planes.first().map(|plane| plane.sphere_index) else { continue };
                let (sphere, reach) = (&self.manipulator.proxy_spheres()[index], &mut self.reach[index]);
                if std::mem::take(&mut reach.is_weighed) && reach.presses {
                    let way = (&sphere.centre_m, &reach.expected_m);
                    let strengths_n = self.effort.strengths_n(bone, sphere.radius_m, way, planes);
                    for (plane, strength_n) in planes.iter_mut().zip(strengths_n) {
                        plane.strength_n = strength_n;
                    }
                }
            }
        }
        if let Some(rigid) = &mut self.rigid {
            if self.bone.is_none() {
                self.planes.clear();
            }
            rigid.find_contacts(self.manipulator.proxy_spheres(), BODY_MARGIN_M, &mut self.planes);
        }
    }
}

/// Work of a tick that depends on how the tool meets bone.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ToolEffort {
    /// Steps of the tool.
    pub attempts: usize,
    /// Iterations of the contact solver, in all attempts.
    pub iterations: usize,
    /// Searches for the planes of a sphere.
    pub searches: usize,
    /// Voxels listed to compute strengths.
    pub listed: usize,
}

impl ToolEffort {
    /// Returns whether the next attempt is the last.
    fn is_spent(&self) -> bool {
        self.iterations > MOST_ITERATIONS || self.listed > MOST_LISTED
    }

    /// Returns the largest strength of a sphere's planes during a motion from its centre, N.
    fn strengths_n(
        &mut self,
        bone: &mut Bone,
        radius_m: f64,
        (from_m, moved_m): (&Vector3<f64>, &Vector3<f64>),
        planes: &[ContactPlane],
    ) -> [f64; PLANES_PER_SPHERE] {
        let mut most_n = [0.0; PLANES_PER_SPHERE];
        // At most `MAX_REACH_M` over half a radius: a faster tool is lost.
        let count = (moved_m.norm().min(MAX_REACH_M) / (SWEEP_SHARE * radius_m)).ceil().max(1.0) as usize;
        for position in 1..=count {
            let moved_m = moved_m * (position as f64 / count as f64);
            let mut depth_m = [0.0; PLANES_PER_SPHERE];
            for (depth_m, plane) in depth_m.iter_mut().zip(planes) {
                *depth_m = (-(plane.gap_m + plane.normal.dot(&moved_m))).max(0.0);
            }
            let pressing = Pressing { centre_m: from_m + moved_m, radius_m, planes, depth_m };
            for (most_n, strength_n) in most_n.iter_mut().zip(bone.field.strengths_n(&bone.hu, &pressing)) {
                *most_n = strength_n.max(*most_n);
            }
            self.listed += bone.field.listed();
        }
        most_n
    }
}
