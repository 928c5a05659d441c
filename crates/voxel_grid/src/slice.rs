//! Slices: planes through the voxels sampled as pixels, for images and viewers.

use crate::MAX_ORIGIN_M;

/// Largest side of a slice: beyond the largest volume.
pub const LARGEST_SIDE_M: f64 = 20.0;
/// Largest deviation of the axes of a slice from perpendicular unit vectors, in their dot products.
const AXES_TOLERANCE: f64 = 1e-3;

/// A standard plane in radiological orientation. +x is the patient's left, +y posterior, +z the head.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AnatomicalPlane {
    /// Name of the plane.
    pub name: &'static str,
    /// Unit vector to the right of the image.
    pub right: [f64; 3],
    /// Unit vector down the image.
    pub down: [f64; 3],
    /// Orientation letters at the left, right, upper and lower edge: right, left, anterior, posterior, head,
    /// feet.
    pub letters: [&'static str; 4],
}

/// Axial from the feet, coronal from the front, sagittal from the patient's left.
pub const ANATOMICAL: [AnatomicalPlane; 3] = [
    AnatomicalPlane {
        name: "axial",
        right: [1.0, 0.0, 0.0],
        down: [0.0, 1.0, 0.0],
        letters: ["R", "L", "A", "P"],
    },
    AnatomicalPlane {
        name: "coronal",
        right: [1.0, 0.0, 0.0],
        down: [0.0, 0.0, -1.0],
        letters: ["R", "L", "H", "F"],
    },
    AnatomicalPlane {
        name: "sagittal",
        right: [0.0, 1.0, 0.0],
        down: [0.0, 0.0, -1.0],
        letters: ["A", "P", "H", "F"],
    },
];

/// Why a plane is invalid.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum PlaneError {
    /// An implausibly distant centre, or NaN.
    #[error("slice centre {centre_m:?} m; expected -{MAX_ORIGIN_M} to {MAX_ORIGIN_M} m in each coordinate")]
    Centre {
        /// The centre.
        centre_m: [f64; 3],
    },
    /// Axes that are not perpendicular unit vectors.
    #[error("slice axes {right:?} and {down:?}; expected perpendicular unit vectors")]
    Axes {
        /// The axis to the right of the image.
        right: [f64; 3],
        /// The axis down the image.
        down: [f64; 3],
    },
    /// A width or height that is not positive, or too large.
    #[error("slice size {side_m:?} m; expected more than 0 and at most {LARGEST_SIDE_M} m each way")]
    Side {
        /// Width and height.
        side_m: [f64; 2],
    },
}

/// A rectangle in the patient frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    centre_m: [f64; 3],
    right: [f64; 3],
    down: [f64; 3],
    side_m: [f64; 2],
}

impl Plane {
    /// Creates a validated rectangle from its centre, its unit vectors to the right and down, and its width
    /// and height.
    ///
    /// # Errors
    /// Any [`PlaneError`].
    pub fn new(
        centre_m: [f64; 3],
        right: [f64; 3],
        down: [f64; 3],
        side_m: [f64; 2],
    ) -> Result<Plane, PlaneError> {
        // Each test is written so that NaN fails.
        if !centre_m.iter().all(|x| x.abs() <= MAX_ORIGIN_M) {
            return Err(PlaneError::Centre { centre_m });
        }
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let off = [dot(right, right) - 1.0, dot(down, down) - 1.0, dot(right, down)];
        if !off.iter().all(|off| off.abs() <= AXES_TOLERANCE) {
            return Err(PlaneError::Axes { right, down });
        }
        if !side_m.iter().all(|side| *side > 0.0 && *side <= LARGEST_SIDE_M) {
            return Err(PlaneError::Side { side_m });
        }
        Ok(Plane { centre_m, right, down, side_m })
    }

    /// Centre of a pixel in an image of `columns` x `rows`.
    #[inline]
    pub fn pixel_m(&self, [column, row]: [usize; 2], [columns, rows]: [usize; 2]) -> [f64; 3] {
        let from_middle = |index: usize, count: usize, side_m: f64| {
            ((2 * index + 1) as f64 / count.max(1) as f64 - 1.0) * 0.5 * side_m
        };
        let right_m = from_middle(column, columns, self.side_m[0]);
        let down_m = from_middle(row, rows, self.side_m[1]);
        [0, 1, 2].map(|axis| self.centre_m[axis] + self.right[axis] * right_m + self.down[axis] * down_m)
    }

    /// Centres of all pixels, row by row.
    pub fn pixels_m(&self, [columns, rows]: [usize; 2]) -> impl Iterator<Item = [f64; 3]> {
        let plane = *self;
        (0..rows).flat_map(move |row| {
            (0..columns).map(move |column| plane.pixel_m([column, row], [columns, rows]))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RIGHT: [f64; 3] = [1.0, 0.0, 0.0];
    const DOWN: [f64; 3] = [0.0, 0.0, -1.0];

    #[test]
    fn pixels_fill_the_rectangle_row_by_row() {
        let plane = Plane::new([0.01, 0.02, 0.03], RIGHT, DOWN, [0.04, 0.02]).unwrap();
        let pixels: Vec<[f64; 3]> = plane.pixels_m([4, 2]).collect();
        assert_eq!(pixels.len(), 8);
        for (pixel, expected) in
            [(0, [-0.005, 0.02, 0.035]), (3, [0.025, 0.02, 0.035]), (7, [0.025, 0.02, 0.025])]
        {
            let is_near = pixels[pixel].iter().zip(expected).all(|(a, b): (&f64, f64)| (a - b).abs() < 1e-15);
            assert!(is_near, "{pixel}: {:?}, expected {expected:?}", pixels[pixel]);
        }
    }

    #[test]
    fn a_plane_that_is_none_is_refused() {
        for bad in [f64::NAN, f64::INFINITY, -1e300, 101.0] {
            assert!(matches!(
                Plane::new([0.0, bad, 0.0], RIGHT, DOWN, [0.1; 2]),
                Err(PlaneError::Centre { .. })
            ));
        }
        for (right, down) in
            [(RIGHT, RIGHT), ([0.0; 3], DOWN), ([f64::NAN, 0.0, 0.0], DOWN), ([2.0, 0.0, 0.0], DOWN)]
        {
            assert!(matches!(Plane::new([0.0; 3], right, down, [0.1; 2]), Err(PlaneError::Axes { .. })));
        }
        for side in [0.0, -0.1, f64::NAN, f64::INFINITY, 21.0] {
            assert!(matches!(Plane::new([0.0; 3], RIGHT, DOWN, [0.1, side]), Err(PlaneError::Side { .. })));
        }
    }

    #[test]
    fn the_anatomical_planes_are_planes_and_their_letters_say_their_axes() {
        for view in ANATOMICAL {
            assert!(Plane::new([0.0; 3], view.right, view.down, [0.1; 2]).is_ok(), "{}", view.name);
            let letter = |direction: [f64; 3]| match direction {
                [1.0, ..] => "L",
                [_, 1.0, _] => "P",
                [_, _, 1.0] => "H",
                [-1.0, ..] => "R",
                [_, -1.0, _] => "A",
                _ => "F",
            };
            let opposite = |direction: [f64; 3]| direction.map(|x| -x);
            let expected = [opposite(view.right), view.right, opposite(view.down), view.down].map(letter);
            assert_eq!(view.letters, expected, "{}", view.name);
        }
    }
}
