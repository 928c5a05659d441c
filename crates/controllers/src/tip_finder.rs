//! Finds the burr in an X-ray frame.
//!
//! The robot's kinematics give an approximate tip position and direction; the frame gives the actual
//! position. The burr is solid metal, the darkest end of the tool. Within a window around the expected
//! position, the end of the dark region along the expected direction is the burr's front, and the centroid of
//! the dark pixels within one burr diameter of the front is the burr's centre.

use messages::{CArmGeometry, Pose};
use nalgebra::Vector2;

use crate::geometry::{position_m, project, rotation};

/// Half width of the search window.
const WINDOW_M: f64 = 0.008;
/// Pixels below this fraction of full scale count as metal.
const DARK_SHARE: f64 = 0.12;
/// Number of dark pixels allowed beyond the front as noise.
const MAX_STRAY_PIXELS: usize = 2;
/// Minimum number of dark pixels for a sighting.
const MIN_PIXELS: usize = 20;

/// A detected burr.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TipSighting {
    /// Column and row of the burr's centre, pixel centres at integers.
    pub pixel: [f64; 2],
    /// Number of dark pixels in the burr.
    pub dark_pixels: usize,
}

/// Searches for a burr of this radius near `t_world_burr` in a mono16 frame in which metal is dark. `None` if
/// the window is outside the image or contains no metal.
pub fn find_tip(
    c_arm: &CArmGeometry,
    pixels: &[u16],
    t_world_burr: &Pose,
    radius_m: f64,
) -> Option<TipSighting> {
    let centre = position_m(t_world_burr);
    let ahead = centre + rotation(t_world_burr) * nalgebra::Vector3::new(0.0, 0.0, radius_m);
    let (expected, pixels_per_m) = project(c_arm, &centre)?;
    let (front, _) = project(c_arm, &ahead)?;
    let expected = Vector2::from(expected);
    let direction = (Vector2::from(front) - expected).try_normalize(1e-9)?;
    let dark = dark_pixels(c_arm, pixels, &expected, WINDOW_M * pixels_per_m);
    if dark.len() < MIN_PIXELS {
        return None;
    }
    let mut along: Vec<f64> = dark.iter().map(|p| (p - expected).dot(&direction)).collect();
    along.sort_by(f64::total_cmp);
    let end = along[along.len() - 1 - MAX_STRAY_PIXELS];
    let radius = radius_m * pixels_per_m;
    let burr: Vec<Vector2<f64>> = dark
        .into_iter()
        .filter(|p| {
            let offset = (p - expected).dot(&direction);
            offset > end - 2.0 * radius && offset <= end
        })
        .collect();
    if burr.len() < MIN_PIXELS {
        return None;
    }
    let across = Vector2::new(-direction.y, direction.x);
    let lateral = burr.iter().map(|p| (p - expected).dot(&across)).sum::<f64>() / burr.len() as f64;
    let found = expected + direction * (end - radius) + across * lateral;
    Some(TipSighting { pixel: [found.x, found.y], dark_pixels: burr.len() })
}

fn dark_pixels(
    c_arm: &CArmGeometry,
    pixels: &[u16],
    centre: &Vector2<f64>,
    half_width: f64,
) -> Vec<Vector2<f64>> {
    let limit = (DARK_SHARE * f64::from(u16::MAX)) as u16;
    let span = |middle: f64, count: u32| {
        let first = libm::ceil(middle - half_width).max(0.0);
        let last = libm::floor(middle + half_width).min(f64::from(count) - 1.0);
        if last < first { 0..0 } else { first as usize..last as usize + 1 }
    };
    let mut dark = Vec::new();
    for row in span(centre.y, c_arm.rows) {
        for column in span(centre.x, c_arm.columns) {
            if pixels.get(row * c_arm.columns as usize + column).is_some_and(|value| *value < limit) {
                dark.push(Vector2::new(column as f64, row as f64));
            }
        }
    }
    dark
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tool along +x seen from the front: a bar that ends in a disc.
    fn picture(c_arm: &CArmGeometry, end_column: f64, row: f64, radius: f64) -> Vec<u16> {
        let mut pixels = vec![40_000_u16; (c_arm.columns * c_arm.rows) as usize];
        for v in 0..c_arm.rows {
            for u in 0..c_arm.columns {
                let (x, y) = (f64::from(u) - end_column, f64::from(v) - row);
                let bar = x < 0.0 && y.abs() < 0.9 * radius;
                if bar || x * x + y * y < radius * radius {
                    pixels[(v * c_arm.columns + u) as usize] = 500;
                }
            }
        }
        pixels
    }

    #[test]
    fn the_burr_is_found_within_half_a_pixel_though_the_prior_is_off() {
        let c_arm = CArmGeometry {
            source_m: [0.0, 0.7, 0.0],
            detector_centre_m: [0.0, -0.3, 0.0],
            row_axis: [1.0, 0.0, 0.0],
            column_axis: [0.0, 0.0, -1.0],
            pixel_pitch_m: [0.5e-3, 0.5e-3],
            columns: 301,
            rows: 301,
        };
        let radius_m = 3.25e-3;
        let radius = radius_m / 0.7 / 0.5e-3;
        let pixels = picture(&c_arm, 160.0, 145.0, radius);
        // +z of the burr points along world +x; the prior is off by 1 mm in x and z.
        let half = core::f64::consts::FRAC_1_SQRT_2;
        let seen_at = [(160.0 - 150.0) * 0.35e-3, 0.0, (150.0 - 145.0) * 0.35e-3];
        let pose = Pose {
            position_m: [seen_at[0] - 1e-3, 0.0, seen_at[2] + 1e-3],
            orientation_xyzw: [0.0, half, 0.0, half],
        };
        let sighting = find_tip(&c_arm, &pixels, &pose, radius_m).unwrap();
        assert!((sighting.pixel[0] - 160.0).abs() < 0.5, "{sighting:?}");
        assert!((sighting.pixel[1] - 145.0).abs() < 0.5, "{sighting:?}");
        assert!(find_tip(&c_arm, &vec![40_000; 301 * 301], &pose, radius_m).is_none());
    }
}
