//! Requests an X-ray frame every 0.1 s, finds the tip in it, and steers the tip sideways to a target.
//!
//! The tip is the end of the tool's metal: the dark pixel farthest along the tool, refined to the mean of the
//! dark pixels of the last 3 mm. Projected back to the plane of the tool, it gives the sideways error, which
//! drives the tension.

const example = @import("example.zig");
const c = example.c;

const frame_limit_s: f64 = 30.0;
const ticks_between_frames: u64 = 100;
/// Pixels darker than this show metal (full scale: 65535).
const dark: u16 = 8000;
/// Target of the burr: sideways offset from its start (world x).
const target_m: f64 = 0.006;
const gain_n_per_m: f64 = 350.0;
const end_length_m: f64 = 0.003;

const Pixel = struct { column: f64, row: f64 };

fn dot(a: [3]f64, b: [3]f64) f64 {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

fn float(index: usize) f64 {
    return @floatFromInt(index);
}

/// Returns the pixel at the tool's end, or null if there is no metal in the image.
fn findTip(view: c.trb_frame_view) ?Pixel {
    const geometry = view.frame.*.geometry;
    const columns: usize = geometry.columns;
    // +z of the burr in the image: last column of the rotation matrix, projected on rows and columns.
    const x, const y, const z, const w = view.frame.*.t_world_burr.orientation_xyzw;
    const axis = [3]f64{ 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y) };
    const right = dot(geometry.row_axis, axis);
    const down = dot(geometry.column_axis, axis);
    const pixels = view.pixels[0..view.pixel_count];
    var end: f64 = -1e9;
    for (pixels, 0..) |pixel, i| {
        const along = float(i % columns) * right + float(i / columns) * down;
        if (pixel < dark and along > end) end = along;
    }
    const first = end - end_length_m / geometry.pixel_pitch_m[0];
    var count: f64 = 0.0;
    var sum = Pixel{ .column = 0.0, .row = 0.0 };
    for (pixels, 0..) |pixel, i| {
        const along = float(i % columns) * right + float(i / columns) * down;
        if (pixel < dark and along >= first) {
            count += 1.0;
            sum.column += float(i % columns);
            sum.row += float(i / columns);
        }
    }
    return if (count == 0.0) null else .{ .column = sum.column / count, .row = sum.row / count };
}

/// Returns the world x of a column, in the plane of the isocentre: the image is magnified by the ratio of
/// source-detector to source-isocentre distance, 1000 to 700 mm.
fn sidewaysM(view: c.trb_frame_view, column: f64) f64 {
    const geometry = view.frame.*.geometry;
    return (column - 0.5 * (float(geometry.columns) - 1.0)) * geometry.pixel_pitch_m[0] * 0.7;
}

pub fn main() void {
    const client = example.connected();
    var info: c.trb_session_info = undefined;
    _ = example.checked(c.trb_get_info(client, &info));
    var tension_n: f64 = 0.0;
    while (example.nextState(client)) |state| {
        if (state.tick % ticks_between_frames == 0 and state.tick < info.tick_count) {
            var request: u64 = 0;
            var view: c.trb_frame_view = undefined;
            _ = example.checked(c.trb_request_frame(client, null, state.tick, &request));
            if (!example.checked(c.trb_wait_frame(client, request, frame_limit_s, &view))) break;
            if (findTip(view)) |tip| {
                const error_m = target_m - sidewaysM(view, tip.column);
                tension_n += gain_n_per_m * error_m;
                if (tension_n < 0.0) tension_n = 0.0;
                _ = c.printf("tick %4llu  tip at column %6.2f row %6.2f  error %6.3f mm  tension %6.3f N\n", state.tick, tip.column, tip.row, error_m * 1e3, tension_n);
            }
        }
        example.sendTension(client, tension_n);
    }
    _ = example.checked(c.trb_disconnect(client));
    _ = c.fflush(null);
}
