//! Slices of the CT on request: one resampled plane each, never the whole volume.

use std::collections::VecDeque;

use serde::Deserialize;
use voxel_grid::sample::hu_at;
use voxel_grid::slice::{Plane, PlaneError};

use crate::calls::Call;
use crate::services::{Reply, Request};
use crate::surface::Field;

/// Maximum number of columns and of rows of a slice.
pub const MOST_PIXELS: usize = 512;
/// Maximum number of slices in progress per client.
pub const MOST_UNDER_WAY: usize = 8;
/// Pixels per second for all clients together: 8 slices of the largest size, each of which takes 19 ms of one
/// core.
pub const PIXELS_PER_S: u64 = 2_097_152;
/// Reply if there is nothing to slice.
pub(crate) const NO_VOLUME: &str = "the scene has no `[volume]`, so there is no CT to show";
/// Value of a pixel outside the volume.
pub const OUTSIDE: i16 = i16::MIN;
/// Value of a pixel in a drilled voxel.
pub const DRILLED: i16 = i16::MIN + 1;

/// Name of the encoding of [`Slice::bytes`].
pub const ENCODING: &str = "trabecula.slice";
const MAGIC: u32 = 0x434C_5354; // "TSLC"
const VERSION: u32 = 1;

/// Why a slice request is refused.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum SliceError {
    /// Invalid plane.
    #[error(transparent)]
    Plane(#[from] PlaneError),
    /// Too few or too many pixels.
    #[error("{columns} x {rows} pixels; expected 1 to {MOST_PIXELS} each way")]
    Pixels {
        /// Columns.
        columns: u64,
        /// Rows.
        rows: u64,
    },
}

/// A `/slice` request as received.
#[derive(Debug, Clone, Copy, Deserialize)]
struct SliceParameters {
    centre_m: [f64; 3],
    right: [f64; 3],
    down: [f64; 3],
    side_m: [f64; 2],
    columns: u64,
    rows: u64,
}

/// A `/slice` request: a rectangle and its pixels.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(try_from = "SliceParameters")]
pub struct Slice {
    plane: Plane,
    pixels: [usize; 2],
}

impl TryFrom<SliceParameters> for Slice {
    type Error = SliceError;

    fn try_from(asked: SliceParameters) -> Result<Slice, SliceError> {
        let SliceParameters { centre_m, right, down, side_m, columns, rows } = asked;
        let allowed = 1..=MOST_PIXELS as u64;
        if !allowed.contains(&columns) || !allowed.contains(&rows) {
            return Err(SliceError::Pixels { columns, rows });
        }
        Ok(Slice {
            plane: Plane::new(centre_m, right, down, side_m)?,
            pixels: [columns as usize, rows as usize],
        })
    }
}

impl Slice {
    /// Number of pixels.
    pub fn pixel_count(&self) -> u64 {
        (self.pixels[0] * self.pixels[1]) as u64
    }

    /// Returns the slice through a volume, little-endian: magic, version, columns, rows (u32), number of
    /// drilled voxels (u64), then row by row the Hounsfield units (i16), [`OUTSIDE`] or [`DRILLED`].
    pub fn bytes(&self, field: &Field, hu: &[i16]) -> Vec<u8> {
        let [columns, rows] = self.pixels;
        let mut bytes = Vec::with_capacity(24 + 2 * columns * rows);
        for word in [MAGIC, VERSION, columns as u32, rows as u32] {
            bytes.extend_from_slice(&word.to_le_bytes());
        }
        bytes.extend_from_slice(&field.removed_count().to_le_bytes());
        for point_m in self.plane.pixels_m(self.pixels) {
            bytes.extend_from_slice(&pixel(field, hu, point_m).to_le_bytes());
        }
        bytes
    }
}

fn pixel(field: &Field, hu: &[i16], point_m: [f64; 3]) -> i16 {
    let grid = field.grid();
    let voxel = grid.voxel_at(point_m);
    if grid.index_of(voxel).is_some_and(|index| field.is_removed(index)) {
        return DRILLED;
    }
    // The two reserved values are out of a CT's range; if they occur, they are shown as the nearest valid
    // one.
    let units = |hu: f64| (hu.round() as i16).max(DRILLED + 1);
    hu_at(grid.dims(), hu, voxel).map_or(OUTSIDE, units)
}

/// A pixel budget that refills at a constant rate, up to one second's worth.
#[derive(Debug, Clone)]
pub struct PixelBudget {
    left: u64,
    filled_ns: u64,
}

impl PixelBudget {
    /// Creates a full budget.
    pub fn new(now_ns: u64) -> PixelBudget {
        PixelBudget { left: PIXELS_PER_S, filled_ns: now_ns }
    }

    /// Takes pixels from the budget; returns false and takes none if there are too few.
    pub fn take(&mut self, pixels: u64, now_ns: u64) -> bool {
        const NS_PER_S: u128 = 1_000_000_000;
        let elapsed_ns = u128::from(now_ns.saturating_sub(self.filled_ns));
        let grown = (elapsed_ns * u128::from(PIXELS_PER_S) / NS_PER_S).min(u128::from(PIXELS_PER_S)) as u64;
        // Time worth less than a pixel carries over to the next call.
        if grown > 0 {
            self.left = (self.left + grown).min(PIXELS_PER_S);
            self.filled_ns = now_ns;
        }
        let is_there = self.left >= pixels;
        if is_there {
            self.left -= pixels;
        }
        is_there
    }
}

/// Requests waiting for pixel budget: those of owners before those of watchers, each in order of arrival.
#[derive(Debug)]
pub struct Slicer {
    budget: PixelBudget,
    waiting: VecDeque<(Slice, Call)>,
}

impl Slicer {
    /// Creates an empty queue.
    pub fn new(now_ns: u64) -> Slicer {
        Slicer { budget: PixelBudget::new(now_ns), waiting: VecDeque::new() }
    }

    /// Queues a request. The queue's length is bounded by the per-client limit on slices in progress.
    pub fn add(&mut self, call: Call) {
        match call.request {
            Request::Slice(slice) => {
                let is_behind = |(_, other): &(Slice, Call)| call.is_owner && !other.is_owner;
                let place = self.waiting.iter().position(is_behind).unwrap_or(self.waiting.len());
                self.waiting.insert(place, (slice, call));
            }
            _ => call.refuse("not a slice"),
        }
    }

    /// Whether requests are waiting.
    pub fn is_busy(&self) -> bool {
        !self.waiting.is_empty()
    }

    /// Answers the requests that the budget allows now.
    pub fn answer(&mut self, field: &Field, hu: &[i16], now_ns: u64) {
        // Clients that have disconnected use up no budget.
        self.waiting.retain(|(_, call)| !call.answer.is_closed());
        while let Some((slice, _)) = self.waiting.front()
            && self.budget.take(slice.pixel_count(), now_ns)
            && let Some((slice, call)) = self.waiting.pop_front()
        {
            call.reply(Reply::Bytes { encoding: ENCODING, bytes: slice.bytes(field, hu) });
        }
    }

    /// Refuses all waiting requests.
    pub fn refuse(&mut self, why: &str) {
        self.waiting.drain(..).for_each(|(_, call)| call.refuse(why));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::Voxel;
    use voxel_grid::VoxelGrid;

    fn asked(text: &str) -> Result<Slice, String> {
        serde_json::from_str::<Slice>(text).map_err(|error| error.to_string())
    }

    fn request(centre: &str, right: &str, side: &str, columns: &str) -> String {
        format!(
            r#"{{"centre_m":{centre},"right":{right},"down":[0,1,0],"side_m":{side},
                "columns":{columns},"rows":4}}"#
        )
    }

    #[test]
    fn what_is_no_slice_is_refused_and_said_why() {
        assert!(asked(&request("[0,0,0]", "[1,0,0]", "[0.1,0.1]", "512")).is_ok());
        for (text, why) in [
            (request("[0,0,0]", "[1,0,0]", "[0.1,0.1]", "513"), "513 x 4 pixels"),
            (request("[0,0,0]", "[1,0,0]", "[0.1,0.1]", "0"), "0 x 4 pixels"),
            (request("[0,0,0]", "[1,0,0]", "[0.1,0.1]", "18446744073709551615"), "pixels"),
            (request("[0,0,0]", "[1,0,0]", "[0.1,0.1]", "-4"), "invalid value"),
            (request("[0,0,1e9]", "[1,0,0]", "[0.1,0.1]", "4"), "slice centre"),
            (request("[0,0,1e999]", "[1,0,0]", "[0.1,0.1]", "4"), "number out of range"),
            (request("[0,0,NaN]", "[1,0,0]", "[0.1,0.1]", "4"), "expected value"),
            (request("[0,0,null]", "[1,0,0]", "[0.1,0.1]", "4"), "null"),
            (request("[0,0,0]", "[0,1,0]", "[0.1,0.1]", "4"), "perpendicular"),
            (request("[0,0,0]", "[1,0,0]", "[0,0.1]", "4"), "more than 0"),
            ("{}".to_owned(), "missing field"),
        ] {
            let refused = asked(&text).unwrap_err();
            assert!(refused.contains(why), "{text}: {refused}, expected `{why}`");
        }
    }

    /// A grid turned by 36.87 degrees about z, whose Hounsfield units encode a voxel's position along the
    /// patient's x.
    #[test]
    fn an_oblique_volume_is_sliced_in_the_patient_frame_and_drilled_voxels_show() {
        let axes = [[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]];
        let grid = VoxelGrid::new([40, 40, 10], [1e-3; 3], [0.0; 3], axes).unwrap();
        let hu: Vec<i16> = (0..grid.voxel_count())
            .map(|index| {
                let voxel = grid.voxel(index).unwrap().map(|place| place as f64);
                (grid.world_m(voxel)[0] * 1e5).round() as i16
            })
            .collect();
        let mut field = Field::new(grid, 0);
        let drilled = grid.voxel_at([0.0, 0.02, 0.004]);
        field.set(grid.index_of(drilled).unwrap() as u32, Voxel::Removed);
        let text = r#"{"centre_m":[0,0.02,0.004],"right":[1,0,0],"down":[0,1,0],"side_m":[0.1,0.005],
            "columns":101,"rows":5}"#;
        let bytes = asked(text).unwrap().bytes(&field, &hu);
        assert_eq!(bytes.len(), 24 + 2 * 101 * 5);
        assert_eq!(bytes[..4], *b"TSLC");
        let value = |column: usize, row: usize| {
            let at = 24 + 2 * (row * 101 + column);
            i16::from_le_bytes([bytes[at], bytes[at + 1]])
        };
        assert_eq!(value(50, 2), DRILLED);
        assert_eq!(bytes[16], 1, "the number of drilled voxels");
        // 8 columns of 100/101 mm from the middle; the tolerance is the rounding of the voxels' units, 0.01
        // mm.
        let expected = 8.0 * 100.0 / 101.0 * 100.0;
        assert!((f64::from(value(58, 2)) - expected).abs() <= 1.0, "{}", value(58, 2));
        assert_eq!((value(0, 0), value(100, 4)), (OUTSIDE, OUTSIDE));
    }

    #[test]
    fn pixels_are_given_evenly() {
        let mut budget = PixelBudget::new(0);
        let each = (MOST_PIXELS * MOST_PIXELS) as u64;
        let mut given = 0_u64;
        // A thousand of the largest slices per second, for 10 s.
        for request in 0..10_000_u64 {
            given += u64::from(budget.take(each, request * 1_000_000));
        }
        let expected = 11 * PIXELS_PER_S / each;
        assert!((expected - 1..=expected).contains(&given), "{given}, expected {expected}");
        assert!(!budget.take(PIXELS_PER_S + 1, u64::MAX), "more than one second of budget at once");
    }
}
