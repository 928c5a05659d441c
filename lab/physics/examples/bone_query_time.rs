//! Times the contact query: 34 spheres of 3 mm in 0.5 mm voxels, in a tunnel, buried and in air; with a fresh
//! search, and tracked while they move by 1.5 um per tick; in a small volume and in one of 512 x 512 x 400
//! voxels; with voxels as parts of a surface and as balls. Also times a tick of drilling.
//!
//! `cargo run --release -p physics_lab --example bone_query_time [-- SCENE fresh|tracked]`

use std::time::Instant;

use nalgebra::Vector3;
use simulation::bone::{BoneField, BoneParameters, BurrState, ContactBuffer, ContactKind, GridGeometry};

const SPHERES: usize = 34;
const RADIUS_M: f64 = 3.0e-3;
const REPEATS: usize = 2000;
/// A tick of a scene looks ahead by 0.1 mm plus the travel of a sphere.
const MARGIN_M: f64 = 0.2e-3;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    for dims in [[256, 256, 200], [512, 512, 400]] {
        for contact in [ContactKind::Planes, ContactKind::VoxelBalls] {
            println!("{} x {} x {} voxels, {contact:?}", dims[0], dims[1], dims[2]);
            time_volume(dims, contact)?;
        }
    }
    Ok(())
}

fn time_volume(dims: [usize; 3], contact: ContactKind) -> Result<(), Box<dyn std::error::Error>> {
    // Air below z = 19.75 mm, bone above.
    let geometry = GridGeometry::axis_aligned(dims, [0.5e-3; 3], Vector3::zeros());
    let mut hu = vec![1000i16; geometry.voxel_count()];
    for value in hu.iter_mut().take(dims[0] * dims[1] * 40) {
        *value = -1000;
    }
    let mut field = BoneField::new(geometry, &hu, BoneParameters { contact, ..BoneParameters::default() })?;
    // A tunnel along x, one askew, both of the burr's radius plus its reach.
    field.predrill_capsule(
        &Vector3::new(0.0, 40.0e-3, 40.0e-3),
        &Vector3::new(127e-3, 40.0e-3, 40.0e-3),
        3.35e-3,
    );
    field.predrill_capsule(&Vector3::new(10e-3, 70e-3, 40e-3), &Vector3::new(100e-3, 110e-3, 80e-3), 3.35e-3);

    let along = |start: Vector3<f64>, step: Vector3<f64>| -> Vec<Vector3<f64>> {
        (0..SPHERES).map(|n| start + step * n as f64).collect()
    };
    let askew = Vector3::new(90e-3, 40e-3, 40e-3).normalize();
    let scenes = [
        ("air", along(Vector3::new(64e-3, 64e-3, 10e-3), Vector3::x() * 1.31e-3)),
        ("tunnel, centred", along(Vector3::new(30e-3, 40e-3, 40e-3), Vector3::x() * 1.31e-3)),
        ("tunnel, resting", along(Vector3::new(30e-3, 40e-3, 39.65e-3), Vector3::x() * 1.31e-3)),
        ("askew tunnel", along(Vector3::new(10e-3, 70e-3, 40e-3) + askew * 20e-3, askew * 1.31e-3)),
        ("flat wall", along(Vector3::new(30e-3, 64e-3, 16.75e-3), Vector3::x() * 1.31e-3)),
        ("buried 5 mm", along(Vector3::new(30e-3, 64e-3, 24.75e-3), Vector3::x() * 1.31e-3)),
        ("buried 30 mm", along(Vector3::new(30e-3, 64e-3, 50e-3), Vector3::x() * 1.31e-3)),
    ];
    // Arguments: only the scenes whose name contains the first, only fresh or tracked queries, no drilling
    // (for a profiler).
    let wanted: Vec<String> = std::env::args().skip(1).collect();
    let is_wanted =
        |place: usize, name: &str| wanted.get(place).is_none_or(|wanted| name.contains(wanted.as_str()));
    for (name, centres) in &scenes {
        for way in ["fresh", "tracked"] {
            if is_wanted(0, name) && is_wanted(1, way) {
                time_queries(&mut field, (name, way), centres);
            }
        }
    }
    if wanted.is_empty() {
        time_grind(&mut field, &hu)?;
    }
    Ok(())
}

fn time_queries(field: &mut BoneField, (name, way): (&str, &str), centres: &[Vector3<f64>]) {
    let mut buffer = ContactBuffer::with_capacity(4 * SPHERES);
    let mut times_us = Vec::with_capacity(REPEATS);
    let direction = (centres[1] - centres[0]).normalize();
    for tick in 0..REPEATS {
        let moved = direction * (tick as f64 * 1.5e-6);
        let start = Instant::now();
        buffer.clear();
        for (sphere, centre) in centres.iter().enumerate() {
            let centre = centre + moved;
            if way == "fresh" {
                field.voxels().contact_planes(sphere, &centre, RADIUS_M, MARGIN_M, &mut buffer);
            } else {
                field.contact_planes_tracked(sphere, &centre, RADIUS_M, MARGIN_M, &mut buffer);
            }
        }
        times_us.push(start.elapsed().as_secs_f64() * 1e6);
    }
    times_us.sort_by(f64::total_cmp);
    println!(
        "{name:>16}, {way:>7}: {:7.2} us median, {:7.2} us p99 for {SPHERES} spheres, {} planes",
        times_us[REPEATS / 2],
        times_us[REPEATS * 99 / 100],
        buffer.planes().len()
    );
}

/// Times one tick of drilling with a burr held half inside the bone's surface.
fn time_grind(field: &mut BoneField, hu: &[i16]) -> Result<(), Box<dyn std::error::Error>> {
    let burr = BurrState {
        centre_m: Vector3::new(90e-3, 90e-3, 20e-3),
        radius_m: 3.25e-3,
        speed_rad_s: 235.0,
        normal_force_n: 0.01,
    };
    let mut times_us = Vec::with_capacity(REPEATS);
    let mut cut = 0;
    for _ in 0..REPEATS {
        let start = Instant::now();
        cut = field.grind(hu, &burr, 1.0e-3)?.cut_count;
        times_us.push(start.elapsed().as_secs_f64() * 1e6);
    }
    times_us.sort_by(f64::total_cmp);
    println!("grind, 3.25 mm burr half in bone: {:.2} us median, {cut} voxels cut", times_us[REPEATS / 2]);
    Ok(())
}
