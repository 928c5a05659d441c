//! The caches of contact and drilling do not change a bit, whatever moves and whatever is drilled.

#![allow(clippy::unwrap_used, reason = "a world that cannot be built or stepped fails the test")]

use std::sync::OnceLock;

use messages::{Latched, SOURCE_FRESH, SOURCE_HELD};
use nalgebra::{Rotation3, Vector3};
use proptest::prelude::*;
use simulation::bone::{
    BoneField, BoneParameters, BurrState, ContactBuffer, ContactKind, GridGeometry, Removal,
};
use simulation::{CtView, Simulation};

use crate::common;

const DIMS: [usize; 3] = [26, 24, 22];
const MARGIN_M: f64 = 0.2e-3;
/// Maximum steps of a sphere drifting to a wall.
const DRIFT_STEPS: usize = 400;
/// Ticks of [`hash_chain`]: enough that the burr removes voxels.
const TICKS: usize = 800;
/// Ticks that begin with a reset: the burr has cut a little by then, but has not moved far enough to trigger
/// a new search.
const RESETS: [usize; 3] = [8, 20, 45];
/// Hash chain of a simulation that keeps its caches.
static KEPT: OnceLock<Vec<[u64; 2]>> = OnceLock::new();

/// An event in a tick.
#[derive(Debug, Clone, Copy)]
enum Event {
    /// The spheres move by this, m.
    Move([f64; 3]),
    /// A burr cuts at sphere 0 for some ticks without a query in between, and then does not press for some.
    Drill {
        force_n: f64,
        ticks: usize,
        idle_ticks: usize,
    },
    /// The caches are rebuilt.
    Rebuild,
    Save,
    Restore,
    Reset,
    Predrill,
}

fn event() -> impl Strategy<Value = Event> {
    // From the motion of a fed tool to jumps across voxels.
    let size = prop_oneof![Just(2.0e-6), Just(2.0e-5), Just(2.0e-4), Just(2.0e-3)];
    let step =
        (size, prop::array::uniform3(-1.0..1.0f64)).prop_map(|(size, d)| Event::Move(d.map(|x| x * size)));
    prop_oneof![
        20 => step,
        10 => (0.1..40.0f64, 1..4usize, 0..3usize).prop_map(|(force_n, ticks, idle_ticks)| Event::Drill {
            force_n,
            ticks,
            idle_ticks,
        }),
        1 => Just(Event::Rebuild),
        1 => Just(Event::Save),
        1 => Just(Event::Restore),
        1 => Just(Event::Reset),
        1 => Just(Event::Predrill),
    ]
}

fn bits(buffer: &ContactBuffer) -> Vec<[u64; 8]> {
    let numbers = |plane: &simulation::contact_plane::ContactPlane| {
        let (p, n) = (plane.point_m, plane.normal);
        [plane.sphere_index as f64, p.x, p.y, p.z, n.x, n.y, n.z, plane.gap_m].map(f64::to_bits)
    };
    buffer.planes().iter().map(numbers).collect()
}

/// Solid bone, or scattered voxels (more than a track holds), in a rotated anisotropic grid.
fn scattered(spacing_m: [f64; 3], scatter: u64) -> (GridGeometry, Vec<i16>) {
    let direction_world_grid = Rotation3::from_euler_angles(0.3, -0.7, 1.1).into_inner();
    let origin_world_m = Vector3::new(0.1, -0.2, 0.3);
    let geometry = GridGeometry { dims: DIMS, spacing_m, direction_world_grid, origin_world_m };
    let solid = |n: u64| scatter == 0 || n.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 60 < scatter;
    let hu = (0..geometry.voxel_count() as u64).map(|n| if solid(n) { 400 } else { -1000 }).collect();
    (geometry, hu)
}

/// Events; voxel size, burr radius, scatter of the bone (0: solid), and start position in the grid.
fn drilled() -> impl Strategy<Value = (Vec<Event>, [f64; 3], f64, u64, [f64; 3])> {
    (
        prop::collection::vec(event(), 1..60),
        prop::array::uniform3(0.35e-3..0.9e-3f64),
        1.0e-3..3.9e-3f64,
        prop_oneof![3 => Just(0u64), 1 => 2u64..6],
        prop::array::uniform3(0.2..0.8f64),
    )
}

/// A sphere in a hole a quarter of a millimetre wider drifts to the wall by 2 um per step, while a burr at
/// the hole's end cuts: it meets each plane in the same step as a new search does.
#[test]
fn a_sphere_that_drifts_to_a_wall_meets_it_in_the_same_step_as_a_new_search() {
    let (radius_m, margin_m) = (3.0e-3, 3.0e-5);
    let mut met = 0;
    for turn in 0..40 {
        let (geometry, hu) = scattered([0.5e-3; 3], 0);
        let mut field = BoneField::new(geometry, &hu, BoneParameters::default()).unwrap();
        let at = |x: f64| geometry.point_to_world(&Vector3::new(x, 6.1e-3, 5.4e-3));
        let (entry, end) = (at(-1.0e-3), at(7.0e-3));
        field.predrill_capsule(&entry, &end, radius_m + 0.25e-3);
        let (sin, cos) = (0.4 + f64::from(turn)).sin_cos();
        let along = (end - entry).normalize();
        let across = along.cross(&Vector3::new(cos, sin, 0.3)).normalize();
        let step = 2.0e-6 * (across + along * (0.2 * f64::from(turn % 3))).normalize();
        let mut burr =
            BurrState { centre_m: end, radius_m: 3.25e-3, speed_rad_s: 800.0, normal_force_n: 2.0 };
        let mut centre = at(5.0e-3);
        let (mut tracked, mut fresh) = (ContactBuffer::with_capacity(32), ContactBuffer::with_capacity(32));
        for _ in 0..DRIFT_STEPS {
            centre += step;
            burr.centre_m += 1.0e-6 * along;
            field.grind(&hu, &burr, 1.0e-3).unwrap();
            tracked.clear();
            fresh.clear();
            field.contact_planes_tracked(0, &centre, radius_m, margin_m, &mut tracked);
            field.voxels().contact_planes(0, &centre, radius_m, margin_m, &mut fresh);
            assert_eq!(bits(&tracked), bits(&fresh), "direction {turn}");
            if !fresh.planes().is_empty() {
                met += 1;
                break;
            }
        }
    }
    assert!(met > 30, "{met} of 40 directions reach a wall");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(150))]

    /// Solid bone with a hole, or scattered voxels (more than a track holds), in a rotated anisotropic grid
    /// with wide and narrow tents; three spheres of one size near the hole's end.
    #[test]
    fn tracked_planes_are_the_fresh_ones_bit_for_bit(
        (events, spacing, radius_m, scatter, place) in drilled(),
        room_m in prop_oneof![Just(0.1e-3), 0.1e-3..0.5e-3f64],
        contact in prop_oneof![3 => Just(ContactKind::Planes), 1 => Just(ContactKind::VoxelBalls)],
    ) {
        let (geometry, hu) = scattered(spacing, scatter);
        let parameters = BoneParameters { contact, ..BoneParameters::default() };
        let mut field = BoneField::new(geometry, &hu, parameters).unwrap();
        let local = |t: [f64; 3]| {
            geometry.point_to_world(&Vector3::from_fn(|a, _| t[a] * DIMS[a] as f64 * spacing[a]))
        };
        let entry = local([-0.1, place[1], place[2]]);
        let mut centre = local(place);
        field.predrill_capsule(&entry, &centre, radius_m + room_m);
        let along = (entry - centre).normalize();
        let mut saved = field.voxels().snapshot();
        let (mut tracked, mut fresh) = (ContactBuffer::with_capacity(32), ContactBuffer::with_capacity(32));
        for event in events {
            match event {
                Event::Move(step) => centre += Vector3::from(step),
                Event::Drill { force_n, ticks, idle_ticks } => {
                    let mut burr = BurrState {
                        centre_m: centre,
                        radius_m,
                        speed_rad_s: 800.0,
                        normal_force_n: force_n,
                    };
                    // A tenth of a second per tick, so that voxels are removed within a few events.
                    for _ in 0..ticks {
                        field.grind(&hu, &burr, 0.1).unwrap();
                    }
                    burr.normal_force_n = 0.0;
                    for _ in 0..idle_ticks {
                        field.grind(&hu, &burr, 0.1).unwrap();
                    }
                }
                Event::Rebuild => field.rebuild_caches(),
                Event::Save => saved = field.voxels().snapshot(),
                Event::Restore => {
                    // Refused after another pilot hole; nothing changes then.
                    let _ = field.restore(&saved);
                }
                Event::Reset => field.reset(),
                Event::Predrill => {
                    field.predrill_capsule(&centre, &(centre + along * 1e-3), 0.8e-3);
                }
            }
            tracked.clear();
            fresh.clear();
            for sphere in 0..3 {
                let centre = centre + along * (1.3e-3 * sphere as f64);
                let margin_m = MARGIN_M + 1.0e-6 * sphere as f64;
                field.contact_planes_tracked(sphere, &centre, radius_m, margin_m, &mut tracked);
                field.voxels().contact_planes(sphere, &centre, radius_m, margin_m, &mut fresh);
            }
            prop_assert_eq!(bits(&tracked), bits(&fresh));
        }
    }

    /// Two fields drilled alike; one is saved and restored before every tick, which empties its caches.
    #[test]
    fn a_burr_that_was_searched_before_cuts_what_a_fresh_one_cuts_bit_for_bit(
        (events, spacing, radius_m, scatter, place) in drilled(),
        rule in prop_oneof![
            4 => Just(Removal::Energy),
            1 => Just(Removal::Capped),
            1 => Just(Removal::Decrement)
        ],
    ) {
        let (geometry, hu) = scattered(spacing, scatter);
        // Few blocks, so that the pool runs out occasionally.
        let parameters = BoneParameters { removal: rule, pool_blocks: 12, ..BoneParameters::default() };
        let mut fields = [0, 1].map(|_| BoneField::new(geometry, &hu, parameters).unwrap());
        let mut centre = geometry.point_to_world(
            &Vector3::from_fn(|a, _| place[a] * DIMS[a] as f64 * spacing[a]),
        );
        let mut saved = fields[0].voxels().snapshot();
        let mut speed_rad_s = 800.0;
        for event in events {
            let force_n = match event {
                Event::Drill { force_n, .. } => force_n,
                Event::Rebuild => {
                    fields[0].rebuild_caches();
                    continue;
                }
                Event::Move(step) => {
                    centre += Vector3::from(step);
                    1.0
                }
                Event::Save => {
                    saved = fields[0].voxels().snapshot();
                    continue;
                }
                Event::Restore => {
                    let restored = fields.each_mut().map(|field| field.restore(&saved).is_ok());
                    prop_assert_eq!(restored[0], restored[1]);
                    continue;
                }
                Event::Reset => {
                    fields.iter_mut().for_each(BoneField::reset);
                    continue;
                }
                Event::Predrill => {
                    let holes =
                        fields.each_mut().map(|field| field.predrill_capsule(&centre, &centre, 0.8e-3));
                    prop_assert_eq!(&holes[0], &holes[1]);
                    speed_rad_s = -speed_rad_s;
                    continue;
                }
            };
            let burr = BurrState { centre_m: centre, radius_m, speed_rad_s, normal_force_n: force_n };
            let fresh = fields[1].voxels().snapshot();
            fields[1].restore(&fresh).unwrap();
            let reports = fields.each_mut().map(|field| field.grind(&hu, &burr, 0.02).unwrap());
            prop_assert_eq!(reports[0], reports[1]);
            prop_assert_eq!(fields[0].voxels().removed_this_tick(), fields[1].voxels().removed_this_tick());
            prop_assert!(fields[0].voxels().snapshot() == fields[1].voxels().snapshot());
        }
    }
}

/// 3 mm/s along +z with the burr on and 3 N on tendon 0; the state's hash after every tick. `rebuilds`
/// selects the ticks before which the caches are rebuilt.
fn hash_chain(bone: &(GridGeometry, Vec<i16>), ticks: usize, rebuilds: &[bool]) -> Vec<[u64; 2]> {
    let ct = CtView { geometry: bone.0, hu: &bone.1 };
    let mut simulation = Simulation::new(&common::scene(common::TUNNEL), Some(ct)).unwrap();
    let command = common::feed_along_z(simulation.state());
    let mut hashes = Vec::with_capacity(ticks);
    for tick in 0..ticks {
        if rebuilds.get(tick).is_some_and(|rebuild| *rebuild) {
            simulation.rebuild_caches();
        }
        let mut latched = Latched { tick: tick as u64, controller_count: 1, ..Latched::zeroed() };
        latched.reset = u32::from(RESETS.contains(&tick));
        latched.commands[0].command = command;
        let fresh = tick == 0 || latched.reset != 0;
        latched.commands[0].source = if fresh { SOURCE_FRESH } else { SOURCE_HELD };
        simulation.step(&latched).unwrap();
        hashes.push(simulation.state().hash);
    }
    assert!(simulation.state().removed_total > 50, "{} voxels", simulation.state().removed_total);
    hashes
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    /// Caches that are dropped at random ticks, from nearly never to nearly always.
    #[test]
    fn a_simulation_without_its_caches_has_the_same_hash_chain(
        rebuilds in (0.01..0.99f64)
            .prop_flat_map(|share| prop::collection::vec(prop::bool::weighted(share), TICKS)),
    ) {
        let bone = common::bone();
        let kept = KEPT.get_or_init(|| hash_chain(&bone, TICKS, &[]));
        let dropped = hash_chain(&bone, TICKS, &rebuilds);
        let first = kept.iter().zip(&dropped).position(|(kept, dropped)| kept != dropped);
        prop_assert_eq!(first, None, "the first tick that differs");
    }
}
