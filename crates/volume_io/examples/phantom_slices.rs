//! Writes pictures of the femur phantom: `cargo run -p volume_io --example phantom_slices -- <folder> [spacing_mm]`.
//!
//! Coronal slices through the neck, an axial slice through the head, one through the trochanters, one through the shaft, and a sagittal
//! slice; window −200..1500 HU.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use volume_io::Volume;
use volume_io::phantom::{FemurSpec, femur, femur_landmarks};

const LOW_HU: f64 = -250.0;
const HIGH_HU: f64 = 1500.0;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args_os().skip(1);
    let folder = PathBuf::from(arguments.next().ok_or("give a folder for the pictures")?);
    let spacing_m = match arguments.next() {
        Some(text) => text.to_string_lossy().parse::<f64>()? * 1e-3,
        None => FemurSpec::default().spacing_m,
    };
    std::fs::create_dir_all(&folder)?;
    let spec = FemurSpec { spacing_m, ..FemurSpec::default() };
    let landmarks = femur_landmarks(&spec)?;
    println!("{landmarks:#?}");
    let start = std::time::Instant::now();
    let volume = femur(&spec)?;
    println!("{:?} voxels in {:.2} s, {:?}", volume.dims, start.elapsed().as_secs_f64(), volume.statistics());

    let column = |world: [f64; 3]| volume.world_to_voxel(world).map(|v| v.round() as usize);
    let head = column(landmarks.head_center_m);
    let crossing = column(landmarks.neck_shaft_crossing_m);
    let lesser = column(landmarks.lesser_trochanter_m);
    write_slice(&folder.join("coronal_head.png"), &volume, 1, head[1])?;
    write_slice(&folder.join("coronal_neck.png"), &volume, 1, (head[1] + crossing[1]) / 2)?;
    write_slice(&folder.join("coronal_shaft.png"), &volume, 1, crossing[1])?;
    write_slice(&folder.join("axial_head.png"), &volume, 2, head[2])?;
    write_slice(&folder.join("axial_neck.png"), &volume, 2, (head[2] + crossing[2]) / 2)?;
    write_slice(&folder.join("axial_lesser_trochanter.png"), &volume, 2, lesser[2])?;
    write_slice(&folder.join("axial_shaft.png"), &volume, 2, 5)?;
    write_slice(&folder.join("sagittal_shaft.png"), &volume, 0, crossing[0])?;
    write_oblique(&folder.join("oblique_neck_plane.png"), &volume, &landmarks)?;
    write_radiograph(&folder.join("radiograph_ap.png"), &volume)?;
    Ok(())
}

/// Writes the slice `index` across `axis`; superior (or anterior) is up, patient right is left as a radiologist looks.
fn write_slice(
    path: &Path,
    volume: &Volume,
    axis: usize,
    index: usize,
) -> Result<(), Box<dyn std::error::Error>> {
    let (across, down) = match axis {
        0 => (1, 2),
        1 => (0, 2),
        _ => (0, 1),
    };
    let (width, height) = (volume.dims[across], volume.dims[down]);
    let mut pixels = Vec::with_capacity(width * height);
    for row in 0..height {
        for column in 0..width {
            let mut voxel = [0; 3];
            voxel[axis] = index;
            voxel[across] = column;
            // z grows upward, rows grow downward; y grows toward the back, which is down in an axial picture already.
            voxel[down] = if down == 2 { height - 1 - row } else { row };
            pixels.push(grey(volume.at(voxel).unwrap_or(i16::MIN)));
        }
    }
    write_png(path, width, height, &pixels)
}

/// Writes the plane through the shaft axis and the neck axis.
fn write_oblique(
    path: &Path,
    volume: &Volume,
    landmarks: &volume_io::phantom::FemurLandmarks,
) -> Result<(), Box<dyn std::error::Error>> {
    let n = landmarks.neck_axis;
    let length = (n[0] * n[0] + n[1] * n[1]).sqrt();
    let (u, c) = ([n[0] / length, n[1] / length], landmarks.neck_shaft_crossing_m);
    let (width, height, step) = (240, 320, 0.5e-3);
    let mut pixels = Vec::with_capacity(width * height);
    for row in 0..height {
        for column in 0..width {
            let a = (column as f64 - 90.0) * step;
            let z = landmarks.head_center_m[2] + 0.035 - row as f64 * step;
            let voxel = volume.world_to_voxel([c[0] + a * u[0], c[1] + a * u[1], z]).map(|v| v.round());
            let inside = voxel.iter().all(|v| *v >= 0.0);
            let hu = inside.then(|| volume.at(voxel.map(|v| v as usize))).flatten();
            pixels.push(grey(hu.unwrap_or(i16::MIN)));
        }
    }
    write_png(path, width, height, &pixels)
}

/// Writes the sum along y, as a radiograph from the front would show it.
fn write_radiograph(path: &Path, volume: &Volume) -> Result<(), Box<dyn std::error::Error>> {
    let [width, depth, height] = volume.dims;
    let mut sums = Vec::with_capacity(width * height);
    for row in 0..height {
        for column in 0..width {
            let sum: f64 = (0..depth)
                .filter_map(|j| volume.at([column, j, height - 1 - row]))
                .map(|hu| f64::from(hu) + 1000.0)
                .sum();
            sums.push(sum);
        }
    }
    let highest = sums.iter().copied().fold(1.0, f64::max);
    let pixels: Vec<u8> = sums.iter().map(|s| (255.0 * (s / highest)) as u8).collect();
    write_png(path, width, height, &pixels)
}

fn grey(hu: i16) -> u8 {
    (255.0 * ((f64::from(hu) - LOW_HU) / (HIGH_HU - LOW_HU)).clamp(0.0, 1.0)) as u8
}

fn write_png(
    path: &Path,
    width: usize,
    height: usize,
    pixels: &[u8],
) -> Result<(), Box<dyn std::error::Error>> {
    let mut encoder = png::Encoder::new(BufWriter::new(File::create(path)?), width as u32, height as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.write_header()?.write_image_data(pixels)?;
    println!("{}", path.display());
    Ok(())
}
