//! The C-arm: a point source and a flat detector in the world (patient LPS: +x left, +y posterior, +z head).

use crate::error::{DrrError, check_orthonormal, check_range};
use crate::vector::{Vec3, add_scaled, cross, dot, scale, sub};

/// Tolerance on the orthonormality of the detector axes.
const AXES_LIMIT: f64 = 1e-6;
/// Maximum number of pixels along one side of the detector.
const MAX_SIDE: u32 = 8192;

/// Detector size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DetectorFormat {
    /// Pixels in a row.
    pub columns: u32,
    /// Pixels in a column.
    pub rows: u32,
    /// Distance between pixel centres along a row and along a column.
    pub pixel_pitch_m: [f64; 2],
}

/// Positioner angles as defined in DICOM PS3.3 C.8.7.5, in the patient frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PositionerAngles {
    /// (0018,1510): 0 with the detector facing the chest, +90 degrees at the patient's left (LAO), -90 at the
    /// right (RAO).
    pub primary_rad: f64,
    /// (0018,1511): +90 degrees with the detector at the head (cranial), -90 caudal.
    pub secondary_rad: f64,
}

impl PositionerAngles {
    /// Anteroposterior: detector at the chest.
    pub const AP: Self = Self { primary_rad: 0.0, secondary_rad: 0.0 };

    /// From degrees, the unit of the DICOM attributes.
    pub fn from_degrees(primary: f64, secondary: f64) -> Self {
        Self { primary_rad: primary.to_radians(), secondary_rad: secondary.to_radians() }
    }
}

/// A point source and a flat detector. Pixel (0, 0) is the first pixel of the first row. Pixel centres are at
/// integers, so `detector_centre_m` is at column (columns - 1)/2, row (rows - 1)/2.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CArm {
    /// Focal spot.
    pub source_m: [f64; 3],
    /// Centre of the detector's area.
    pub detector_centre_m: [f64; 3],
    /// Unit vector along a row, in the direction of increasing column index.
    pub row_axis: [f64; 3],
    /// Unit vector along a column, in the direction of increasing row index (down in the image).
    pub column_axis: [f64; 3],
    /// Distance between pixel centres along a row and along a column.
    pub pixel_pitch_m: [f64; 2],
    /// Pixels in a row.
    pub columns: u32,
    /// Pixels in a column.
    pub rows: u32,
}

/// Projection of a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projection {
    /// Column coordinate; pixel centres are at integers.
    pub column: f64,
    /// Row coordinate.
    pub row: f64,
    /// Depth: distance from the source along the detector normal.
    pub depth_m: f64,
}

impl CArm {
    /// A C-arm rotated about its isocentre. The detector is at `isocentre + (source_detector -
    /// source_isocentre) n`, the source at `isocentre - source_isocentre n`, with `n = (sin p cos s, -cos p
    /// cos s, sin s)` for primary angle p and secondary angle s. The image has the head up and is viewed from
    /// the detector, facing the patient: at AP the patient's right is on the left of the image.
    ///
    /// # Errors
    /// A distance is outside 1 mm to 10 m, the detector is on the source's side of the isocentre, or
    /// [`CArm::validate`] refuses the result.
    pub fn from_positioner_angles(
        isocentre_m: [f64; 3],
        angles: PositionerAngles,
        source_isocentre_m: f64,
        source_detector_m: f64,
        format: DetectorFormat,
    ) -> Result<Self, DrrError> {
        use core::f64::consts::PI;
        check_range("primary_rad", angles.primary_rad, -PI, PI, "-pi to pi rad")?;
        check_range("secondary_rad", angles.secondary_rad, -PI, PI, "-pi to pi rad")?;
        check_range("source_isocentre_m", source_isocentre_m, 1e-3, 10.0, "0.001 to 10 m")?;
        check_range(
            "source_detector_m",
            source_detector_m,
            source_isocentre_m,
            10.0,
            "source_isocentre_m to 10 m (the detector is behind the isocentre)",
        )?;
        let (sp, cp) = libm::sincos(angles.primary_rad);
        let (ss, cs) = libm::sincos(angles.secondary_rad);
        let normal = [sp * cs, -cp * cs, ss];
        let c_arm = Self {
            source_m: add_scaled(isocentre_m, -source_isocentre_m, normal),
            detector_centre_m: add_scaled(isocentre_m, source_detector_m - source_isocentre_m, normal),
            row_axis: [cp, sp, 0.0],
            column_axis: [sp * ss, -cp * ss, -cs],
            pixel_pitch_m: format.pixel_pitch_m,
            columns: format.columns,
            rows: format.rows,
        };
        c_arm.validate()?;
        Ok(c_arm)
    }

    /// Checks every field; the renderer calls this for each new C-arm.
    ///
    /// # Errors
    /// A field is out of range; the error names the first one.
    pub fn validate(&self) -> Result<(), DrrError> {
        let sides = "1 to 8192 pixels";
        check_range("columns", f64::from(self.columns), 1.0, f64::from(MAX_SIDE), sides)?;
        check_range("rows", f64::from(self.rows), 1.0, f64::from(MAX_SIDE), sides)?;
        for p in self.pixel_pitch_m {
            check_range("pixel_pitch_m", p, 1e-6, 0.1, "1e-6 to 0.1 m")?;
        }
        for x in self.source_m {
            check_range("source_m", x, -100.0, 100.0, "-100 to 100 m")?;
        }
        for x in self.detector_centre_m {
            check_range("detector_centre_m", x, -100.0, 100.0, "-100 to 100 m")?;
        }
        check_orthonormal("row_axis and column_axis", &[self.row_axis, self.column_axis], AXES_LIMIT)?;
        let distance = dot(sub(self.detector_centre_m, self.source_m), self.normal()).abs();
        check_range(
            "distance of the source from the detector plane, m",
            distance,
            1e-3,
            10.0,
            "0.001 to 10 m",
        )
    }

    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.columns as usize * self.rows as usize
    }

    /// World position of pixel coordinates on the detector.
    pub fn pixel_m(&self, column: f64, row: f64) -> [f64; 3] {
        let u = (column - (f64::from(self.columns) - 1.0) / 2.0) * self.pixel_pitch_m[0];
        let v = (row - (f64::from(self.rows) - 1.0) / 2.0) * self.pixel_pitch_m[1];
        add_scaled(add_scaled(self.detector_centre_m, u, self.row_axis), v, self.column_axis)
    }

    /// Projects a world point; `None` for a point level with or behind the source.
    pub fn project(&self, point_m: [f64; 3]) -> Option<Projection> {
        self.pinhole().project(point_m)
    }

    /// The projection with precomputed constants, for many points.
    pub fn pinhole(&self) -> Pinhole {
        let mut normal = self.normal();
        let offset = sub(self.detector_centre_m, self.source_m);
        let mut focal = dot(offset, normal);
        if focal < 0.0 {
            normal = scale(normal, -1.0);
            focal = -focal;
        }
        let [pu, pv] = self.pixel_pitch_m;
        Pinhole {
            source_m: self.source_m,
            normal,
            column: scale(self.row_axis, focal / pu),
            row: scale(self.column_axis, focal / pv),
            column_0: (f64::from(self.columns) - 1.0) / 2.0 - dot(offset, self.row_axis) / pu,
            row_0: (f64::from(self.rows) - 1.0) / 2.0 - dot(offset, self.column_axis) / pv,
        }
    }

    fn normal(&self) -> Vec3 {
        cross(self.row_axis, self.column_axis)
    }
}

/// A C-arm's projection: column = column_0 + (c . q)/(n . q) with q the vector from the source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pinhole {
    source_m: Vec3,
    normal: Vec3,
    column: Vec3,
    row: Vec3,
    column_0: f64,
    row_0: f64,
}

impl Pinhole {
    /// Projects a world point; `None` for a point level with or behind the source.
    pub fn project(&self, point_m: [f64; 3]) -> Option<Projection> {
        self.finish(self.homogeneous(point_m))
    }

    /// Projects the corners `centre + sum(+-half[i])` of a box; bit i of a corner's index is the sign of
    /// `half[i]`.
    pub(crate) fn corners(&self, centre_m: [f64; 3], half_m: &[[f64; 3]; 3]) -> [Option<Projection>; 8] {
        core::array::from_fn(|corner| {
            let sign = |axis: usize| if corner >> axis & 1 == 1 { 1.0 } else { -1.0 };
            let mut p = centre_m;
            for (axis, h) in half_m.iter().enumerate() {
                p = add_scaled(p, sign(axis), *h);
            }
            self.project(p)
        })
    }

    /// Homogeneous image coordinates of a world point: the numerators of column and row, then the depth.
    /// Linear in the point.
    pub(crate) fn seen(&self, point_m: Vec3) -> Vec3 {
        self.homogeneous(point_m)
    }

    /// Column and row of homogeneous coordinates ([`Pinhole::seen`]) in front of the source.
    pub(crate) fn pixel(&self, seen: Vec3) -> [f64; 2] {
        [self.column_0 + seen[0] / seen[2], self.row_0 + seen[1] / seen[2]]
    }

    /// Coefficients of a plane `normal . seen = d`: a pixel sees it at depth `d / (slope . (column, row,
    /// 1))`.
    pub(crate) fn slope(&self, normal: Vec3) -> Vec3 {
        [normal[0], normal[1], normal[2] - normal[0] * self.column_0 - normal[1] * self.row_0]
    }

    /// Returns true if column, row and depth form a right-handed system like the world's axes.
    pub(crate) fn is_right_handed(&self) -> bool {
        dot(cross(self.column, self.row), self.normal) > 0.0
    }

    /// Bounding rectangle, in pixels, of the projected box `centre + sum(+-half[i])`, clipped to the
    /// detector. The whole detector if some corners are level with or behind the source; `None` if all are,
    /// or if the rectangle is empty.
    pub fn bounds(
        &self,
        centre_m: [f64; 3],
        half_m: &[[f64; 3]; 3],
        columns: u32,
        rows: u32,
    ) -> Option<PixelBox> {
        let mut low = [f64::INFINITY; 2];
        let mut high = [f64::NEG_INFINITY; 2];
        let (mut front, mut behind) = (false, false);
        for corner in self.corners(centre_m, half_m) {
            let Some(q) = corner else {
                behind = true;
                continue;
            };
            front = true;
            low = [low[0].min(q.column), low[1].min(q.row)];
            high = [high[0].max(q.column), high[1].max(q.row)];
        }
        match (front, behind) {
            (false, _) => None,
            (true, true) => Some(PixelBox { columns: (0, columns), rows: (0, rows) }),
            (true, false) => PixelBox::covering(low, high, columns, rows),
        }
    }

    /// (c . q, r . q, n . q).
    fn homogeneous(&self, point_m: Vec3) -> Vec3 {
        let q = sub(point_m, self.source_m);
        [dot(self.column, q), dot(self.row, q), dot(self.normal, q)]
    }

    fn finish(&self, h: Vec3) -> Option<Projection> {
        let visible = h[2] > 1e-9;
        visible.then(|| Projection {
            column: self.column_0 + h[0] / h[2],
            row: self.row_0 + h[1] / h[2],
            depth_m: h[2],
        })
    }
}

/// Half-open ranges of columns and rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PixelBox {
    /// First column, and one past the last.
    pub columns: (u32, u32),
    /// First row, and one past the last.
    pub rows: (u32, u32),
}

impl PixelBox {
    /// Margin of the bounding rectangle against rounding in the projection, in pixels.
    const SLACK: f64 = 1e-3;

    /// Returns the intersection with another box; `None` if it is empty.
    pub(crate) fn within(&self, other: &Self) -> Option<Self> {
        let common = |a: (u32, u32), b: (u32, u32)| (a.0.max(b.0), a.1.min(b.1));
        let (columns, rows) = (common(self.columns, other.columns), common(self.rows, other.rows));
        (columns.0 < columns.1 && rows.0 < rows.1).then_some(Self { columns, rows })
    }

    pub(crate) fn covering(low: [f64; 2], high: [f64; 2], columns: u32, rows: u32) -> Option<Self> {
        let range = |a: f64, b: f64, n: u32| {
            // `as` saturates, so a box far outside gives an empty range.
            let first = libm::ceil(a - Self::SLACK).max(0.0) as u32;
            let end = (libm::floor(b + Self::SLACK) + 1.0).clamp(0.0, f64::from(n)) as u32;
            (first < end).then_some((first, end))
        };
        Some(Self { columns: range(low[0], high[0], columns)?, rows: range(low[1], high[1], rows)? })
    }
}
