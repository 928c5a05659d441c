//! From simulated values at ticks to what a sensor reports at its own times.
//!
//! A sensor reports y(t) = gain · q(t − clock offset − delay) + bias, where q is the quantity in the column's
//! unit; positions and forces are first brought into the sensor's frame. Simulated values are interpolated
//! linearly between the ticks around that time. Measured rows are never interpolated: each counts at its own
//! time.

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

/// Parameters of a sensor.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    /// Delay of the reading, s.
    pub delay_s: f64,
    /// Factor.
    pub gain: f64,
    /// Added to each column, in its unit.
    pub bias: Vec<f64>,
    /// Position of the sensor's frame in the frame of the quantity, m.
    pub frame_m: [f64; 3],
    /// Orientation of the sensor's frame: axis times angle, rad.
    pub frame_rad: [f64; 3],
}

/// Simulated values of a quantity at every tick, from tick 0.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Trace {
    /// Length of a tick, s.
    pub dt_s: f64,
    /// Values at a tick.
    pub width: usize,
    /// Values in SI units, tick by tick.
    pub values: Vec<f64>,
}

impl Trace {
    /// Time of the last tick, s.
    pub fn end_s(&self) -> f64 {
        (self.values.len() / self.width.max(1)).saturating_sub(1) as f64 * self.dt_s
    }

    /// Appends the values at a time; before the first and after the last tick, those of that tick.
    pub fn at(&self, time_s: f64, out: &mut Vec<f64>) {
        let last = (self.values.len() / self.width.max(1)).saturating_sub(1);
        let place = (time_s / self.dt_s).clamp(0.0, last as f64);
        let before = (place as usize).min(last.saturating_sub(1));
        let share = place - before as f64;
        let after = (before + 1).min(last);
        for i in 0..self.width {
            let (a, b) = (self.values[before * self.width + i], self.values[after * self.width + i]);
            out.push(a + share * (b - a));
        }
    }
}

/// What a quantity is geometrically, for the sensor's frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shape {
    /// Numbers without a frame.
    Scalars,
    /// A point: moved and turned.
    Point,
    /// A force or torque: turned only.
    Vector,
}

impl Signal {
    /// Changes simulated values in SI units to what the sensor reports, in units of `unit` SI units.
    pub fn report(&self, shape: Shape, unit: f64, values: &mut [f64]) {
        if shape != Shape::Scalars
            && (self.frame_m != [0.0; 3] || self.frame_rad != [0.0; 3])
            && let [x, y, z] = values
        {
            let turn = UnitQuaternion::from_scaled_axis(Vector3::from(self.frame_rad));
            let given = Vector3::new(*x, *y, *z);
            let seen = match shape {
                Shape::Point => {
                    let [a, b, c] = self.frame_m;
                    let frame = Isometry3::from_parts(Translation3::new(a, b, c), turn);
                    frame.inverse_transform_point(&Point3::from(given)).coords
                }
                _ => turn.inverse() * given,
            };
            [*x, *y, *z] = seen.into();
        }
        for (i, value) in values.iter_mut().enumerate() {
            *value = self.gain * *value / unit + self.bias.get(i).copied().unwrap_or(0.0);
        }
    }
}

/// Measured rows: a time for each, and a value for each column; NaN where a value is missing.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Rows {
    /// Times of the file's clock, s.
    pub times_s: Vec<f64>,
    /// Columns.
    pub columns: Vec<Vec<f64>>,
}

/// Times that are equal in decimal differ by less than this, s; clocks of day resolve less.
const ROUNDING_S: f64 = 1e-6;

/// What became of the rows of a measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct RowCount {
    /// Rows in the file.
    pub rows: usize,
    /// Rows without a time.
    pub without_time: usize,
    /// Rows outside the simulated time.
    pub outside: usize,
    /// Values missing in the other rows.
    pub missing_values: usize,
    /// Gaps: intervals longer than five times the median interval.
    pub gaps: usize,
    /// Values that are compared.
    pub compared: usize,
}

impl Rows {
    /// Returns the rows whose time, after an offset between `early_s` and `late_s` is subtracted, lies
    /// within 0 to `end_s` in any case, sorted by time, and what became of all rows.
    pub fn within(&self, early_s: f64, late_s: f64, end_s: f64) -> (Rows, RowCount) {
        let mut count = RowCount { rows: self.times_s.len(), ..RowCount::default() };
        let mut used: Vec<usize> = Vec::new();
        for (row, time_s) in self.times_s.iter().enumerate() {
            match () {
                () if !time_s.is_finite() => count.without_time += 1,
                () if time_s - late_s < -ROUNDING_S || time_s - early_s > end_s + ROUNDING_S => {
                    count.outside += 1;
                }
                () => used.push(row),
            }
        }
        used.sort_by(|a, b| self.times_s[*a].total_cmp(&self.times_s[*b]));
        let picked = |column: &Vec<f64>| -> Vec<f64> { used.iter().map(|row| column[*row]).collect() };
        let rows =
            Rows { times_s: picked(&self.times_s), columns: self.columns.iter().map(picked).collect() };
        let values = rows.columns.iter().flatten();
        count.missing_values = values.clone().filter(|value| !value.is_finite()).count();
        count.compared = rows.columns.iter().map(Vec::len).sum::<usize>() - count.missing_values;
        count.gaps = gaps(&rows.times_s);
        (rows, count)
    }
}

/// Counts the intervals that are longer than five times the median.
fn gaps(times_s: &[f64]) -> usize {
    let mut intervals: Vec<f64> = times_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let ordered = intervals.clone();
    intervals.sort_by(f64::total_cmp);
    let Some(median) = intervals.get(intervals.len() / 2) else { return 0 };
    ordered.iter().filter(|interval| **interval > 5.0 * median && **interval > 0.0).count()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn signal() -> Signal {
        Signal { delay_s: 0.0, gain: 1.0, bias: vec![], frame_m: [0.0; 3], frame_rad: [0.0; 3] }
    }

    #[test]
    fn a_trace_is_interpolated_between_its_ticks_and_held_beyond_them() {
        let trace = Trace { dt_s: 0.5, width: 2, values: vec![0.0, 10.0, 1.0, 20.0, 3.0, 0.0] };
        assert_eq!(trace.end_s(), 1.0);
        for (time_s, expected) in
            [(-1.0, [0.0, 10.0]), (0.25, [0.5, 15.0]), (0.75, [2.0, 10.0]), (9.0, [3.0, 0.0])]
        {
            let mut values = Vec::new();
            trace.at(time_s, &mut values);
            assert_eq!(values, expected, "{time_s}");
        }
    }

    /// A frame at (1, 0, 0), turned by 90° about z: the point (1, 2, 0) is 2 along its x axis.
    #[test]
    fn points_are_moved_into_the_sensors_frame_and_forces_are_only_turned() {
        let quarter = core::f64::consts::FRAC_PI_2;
        let placed = Signal { frame_m: [1.0, 0.0, 0.0], frame_rad: [0.0, 0.0, quarter], ..signal() };
        let mut point = [1.0, 2.0, 0.0];
        placed.report(Shape::Point, 1e-3, &mut point);
        assert!((point[0] - 2000.0).abs() < 1e-9 && point[1].abs() < 1e-9, "{point:?}");
        let mut force = [1.0, 2.0, 0.0];
        Signal { gain: 2.0, bias: vec![0.5], ..placed }.report(Shape::Vector, 1.0, &mut force);
        assert!((force[0] - 4.5).abs() < 1e-12 && (force[1] + 2.0).abs() < 1e-12, "{force:?}");
    }

    #[test]
    fn rows_that_are_not_compared_are_counted() {
        let rows = Rows {
            times_s: vec![0.3, 0.1, f64::NAN, 0.2, 0.99, 5.0, 0.05],
            columns: vec![vec![3.0, 1.0, 0.0, f64::NAN, 9.0, 8.0, 7.0]],
        };
        // A delay between 0.06 and 0.1 s: the row at 0.05 s is too early.
        let (used, count) = rows.within(0.06, 0.1, 1.0);
        assert_eq!(used.times_s, [0.1, 0.2, 0.3, 0.99]);
        let expected =
            RowCount { rows: 7, without_time: 1, outside: 2, missing_values: 1, gaps: 1, compared: 3 };
        assert_eq!(count, expected);
        assert_eq!(used.columns[0][2..], [3.0, 9.0]);
    }
}
