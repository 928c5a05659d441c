//! A plane through the CT as pixels.

use nalgebra::Vector3;
use voxel_grid::{Volume, slice};

use super::metres;
use super::shape::Shapes;

/// Hounsfield units shown as black and as white: soft tissue is dark, dense cortex white.
const WINDOW_HU: [f64; 2] = [-200.0, 1300.0];
/// Grey of points outside the volume.
const OUTSIDE: [u8; 3] = [235, 235, 235];

/// Pilot holes. These colours are light ones of Okabe and Ito (2008), which are visible on grey.
pub const HOLE: [u8; 3] = [86, 180, 233];
/// The tool at the start.
pub const START: [u8; 3] = [240, 228, 66];
/// The tool at the end of the path.
pub const END: [u8; 3] = [255, 140, 60];
/// The predicted tool and path.
pub const PREDICTED: [u8; 3] = [0, 200, 140];

/// A rectangle in the patient frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Plane {
    pub centre_mm: Vector3<f64>,
    /// Unit vector to the right of the picture.
    pub right: Vector3<f64>,
    /// Unit vector down the picture.
    pub down: Vector3<f64>,
    /// Half width and half height, mm.
    pub half_mm: [f64; 2],
}

impl Plane {
    /// Returns a point relative to the centre, mm: to the right, down, and in front of the plane.
    pub fn place_mm(&self, point_mm: &Vector3<f64>) -> [f64; 3] {
        let away = point_mm - self.centre_mm;
        [away.dot(&self.right), away.dot(&self.down), away.dot(&self.right.cross(&self.down))]
    }

    /// Renders the CT in grey with the outlines of the shapes; RGB, row by row.
    pub fn pixels(&self, volume: &Volume, shapes: &Shapes, columns: usize, rows: usize) -> Vec<u8> {
        let mut pixels = Vec::with_capacity(columns * rows * 3);
        let mut inside = Vec::with_capacity(columns * rows);
        let side_m = self.half_mm.map(|half| 2e-3 * half);
        let (right, down) = (self.right.into(), self.down.into());
        let Ok(plane) = slice::Plane::new(metres(self.centre_mm.into()), right, down, side_m) else {
            return OUTSIDE.repeat(columns * rows);
        };
        for point_m in plane.pixels_m([columns, rows]) {
            pixels.extend(volume.hu_at(point_m).map_or(OUTSIDE, grey));
            inside.push(Inside::of(&(Vector3::from(point_m) * 1e3), shapes));
        }
        outline(&mut pixels, &inside, columns, rows);
        pixels
    }
}

fn grey(hu: f64) -> [u8; 3] {
    let share = (hu - WINDOW_HU[0]) / (WINDOW_HU[1] - WINDOW_HU[0]);
    [(255.0 * share.clamp(0.0, 1.0)).round() as u8; 3]
}

/// Which shapes contain a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Inside([bool; 4]);

impl Inside {
    fn of(point: &Vector3<f64>, shapes: &Shapes) -> Inside {
        Inside([
            shapes.predicted.as_ref().is_some_and(|(_, tool)| tool.holds(point)),
            shapes.holes.iter().any(|hole| hole.holds(point)),
            shapes.at_start.holds(point),
            shapes.is_planned && shapes.at_end.holds(point),
        ])
    }
}

/// Colours outlines two pixels wide: pixels inside a shape that are near a pixel outside it.
fn outline(pixels: &mut [u8], inside: &[Inside], columns: usize, rows: usize) {
    for row in 0..rows {
        for column in 0..columns {
            for (which, colour) in [PREDICTED, HOLE, START, END].into_iter().enumerate() {
                if !inside[row * columns + column].0[which] {
                    continue;
                }
                let near = |row: usize, column: usize| {
                    row < rows && column < columns && !inside[row * columns + column].0[which]
                };
                let is_edge = (1..=2).any(|far| {
                    near(row + far, column)
                        || near(row, column + far)
                        || row.checked_sub(far).is_some_and(|row| near(row, column))
                        || column.checked_sub(far).is_some_and(|column| near(row, column))
                });
                if is_edge {
                    let at = (row * columns + column) * 3;
                    pixels[at..at + 3].copy_from_slice(&colour);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_picture::shape::{ToolShape, Tube};
    use crate::scene_picture::surroundings::tests::ball as ball_of;

    /// A ball of bone of 10 mm in air, without shapes.
    fn ball() -> (Volume, Shapes) {
        let volume = ball_of(81, |radius_mm| if radius_mm <= 10.0 { 1300 } else { -1000 });
        let tool = |at: [f64; 3]| {
            let tube = Tube { line_mm: vec![Vector3::from(at)], radius_mm: 3.0 };
            ToolShape { burr: vec![tube.clone()], outer: None, tube }
        };
        let shapes = Shapes {
            holes: Vec::new(),
            path_mm: Vec::new(),
            is_planned: true,
            start_mm: Vector3::zeros(),
            along: Vector3::z(),
            toward: Vector3::x(),
            at_start: tool([0.0, 0.0, -100.0]),
            at_end: tool([0.0, 0.0, 100.0]),
            predicted: None,
            insertion_mm: 0.0,
            tool_mm: 0.0,
        };
        (volume, shapes)
    }

    fn plane(half_mm: f64) -> Plane {
        let (right, down) = (Vector3::x(), Vector3::y());
        Plane { centre_mm: Vector3::zeros(), right, down, half_mm: [half_mm; 2] }
    }

    #[test]
    fn a_ball_has_its_area_in_pixels_and_the_paper_begins_where_the_volume_ends() {
        let (volume, shapes) = ball();
        // No pixel centre is on a face of the volume, where rounding would matter.
        let pixels = plane(24.96).pixels(&volume, &shapes, 500, 500);
        let size_mm: f64 = 2.0 * 24.96 / 500.0;
        let outside = pixels.chunks_exact(3).filter(|pixel| *pixel == OUTSIDE).count() as f64;
        // Half-way between air and bone, 150 HU, is a grey of 59.5.
        let bone = pixels.chunks_exact(3).filter(|pixel| pixel[0] >= 60 && *pixel != OUTSIDE).count() as f64;
        let wanted = core::f64::consts::PI * (10.0 / size_mm).powi(2);
        assert!((bone / wanted - 1.0).abs() < 0.03, "{bone} of {wanted}");
        // The voxels' faces lie at 20.25 mm.
        let inside = (2.0 * 20.25 / size_mm).powi(2);
        assert!((outside / (250_000.0 - inside) - 1.0).abs() < 0.01, "{outside}");
    }

    #[test]
    fn a_tool_is_outlined_to_scale_by_a_ring_two_pixels_wide() {
        let (volume, mut shapes) = ball();
        shapes.at_end.burr[0].line_mm = vec![Vector3::new(0.0, 0.0, 1.8)];
        let pixels = plane(25.0).pixels(&volume, &shapes, 500, 500);
        let ring: Vec<usize> = pixels
            .chunks_exact(3)
            .enumerate()
            .filter(|(_, pixel)| *pixel == END)
            .map(|(index, _)| index)
            .collect();
        // A ball of 3 mm, 1.8 mm off the plane, is cut in a circle of 2.4 mm: 24 pixels.
        let columns = ring.iter().map(|index| index % 500);
        let (low, high) = (columns.clone().min().unwrap(), columns.max().unwrap());
        assert_eq!([low, high], [226, 273], "48 pixels about the middle");
        assert!(ring.len() < 400, "{} pixels: filled?", ring.len());
    }
}
