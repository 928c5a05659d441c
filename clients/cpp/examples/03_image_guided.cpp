// Requests an X-ray frame every 0.1 s, finds the tip in it, and steers the tip sideways to a target.
//
// The tip is the end of the tool's metal: the dark pixel farthest along the tool, refined to the mean of the
// dark pixels of the last 3 mm. Projected back to the plane of the tool, it gives the sideways error, which
// drives the tension.
#include <cinttypes>
#include <cstdio>
#include <optional>

#include "trabecula.hpp"

constexpr double FRAME_LIMIT_S = 30.0;
constexpr std::uint64_t TICKS_BETWEEN_FRAMES = 100;
// Pixels darker than this show metal (full scale: 65535).
constexpr std::uint16_t DARK = 8000;
// Target of the burr: sideways offset from its start (world x).
constexpr double TARGET_M = 0.006;
constexpr double GAIN_N_PER_M = 350.0;
constexpr double END_LENGTH_M = 0.003;

struct Pixel {
    double column, row;
};

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Returns the pixel at the tool's end, or null if there is no metal in the image.
static std::optional<Pixel> find_tip(const trb_frame_view &view) {
    const trb_c_arm_geometry &geometry = view.frame->geometry;
    const std::uint64_t columns = geometry.columns;
    // +z of the burr in the image: last column of the rotation matrix, projected on rows and columns.
    const auto &[x, y, z, w] = view.frame->t_world_burr.orientation_xyzw;
    const double axis[3] = {2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)};
    const double right = dot(geometry.row_axis, axis), down = dot(geometry.column_axis, axis);
    const auto along = [&](std::uint64_t i) {
        return static_cast<double>(i % columns) * right + static_cast<double>(i / columns) * down;
    };
    double end = -1e9;
    for (std::uint64_t i = 0; i < view.pixel_count; i++)
        if (view.pixels[i] < DARK && along(i) > end) end = along(i);
    const double first = end - END_LENGTH_M / geometry.pixel_pitch_m[0];
    double count = 0.0;
    Pixel sum = {0.0, 0.0};
    for (std::uint64_t i = 0; i < view.pixel_count; i++) {
        if (view.pixels[i] < DARK && along(i) >= first) {
            count += 1.0;
            sum.column += static_cast<double>(i % columns);
            sum.row += static_cast<double>(i / columns);
        }
    }
    if (count == 0.0) return std::nullopt;
    return Pixel{sum.column / count, sum.row / count};
}

// Returns the world x of a column, in the plane of the isocentre: the image is magnified by the ratio of
// source-detector to source-isocentre distance, 1000 to 700 mm.
static double sideways_m(const trb_frame_view &view, double column) {
    const trb_c_arm_geometry &geometry = view.frame->geometry;
    return (column - 0.5 * (static_cast<double>(geometry.columns) - 1.0)) * geometry.pixel_pitch_m[0] * 0.7;
}

int main() try {
    trabecula::Client client;
    const std::uint64_t last_tick = client.info().tick_count;
    double tension_n = 0.0;
    while (const trb_state *state = client.wait_state()) {
        if (state->tick % TICKS_BETWEEN_FRAMES == 0 && state->tick < last_tick) {
            const auto view = client.wait_frame(client.request_frame(state->tick), FRAME_LIMIT_S);
            if (const auto tip = find_tip(view)) {
                const double error_m = TARGET_M - sideways_m(view, tip->column);
                tension_n += GAIN_N_PER_M * error_m;
                if (tension_n < 0.0) tension_n = 0.0;
                std::printf("tick %4" PRIu64 "  tip at column %6.2f row %6.2f  error %6.3f mm  tension %6.3f N\n",
                            state->tick, tip->column, tip->row, error_m * 1e3, tension_n);
            }
        }
        auto command = client.command();
        command->tendon_mode = TRB_TENDON_SERVO_JF;
        command->tendon_force_n[0] = tension_n;
        command.send();
    }
} catch (const trabecula::Error &error) {
    if (error.status() == TRB_ENDED) return 0;  // while waiting for a frame
    std::fprintf(stderr, "error %d: %s\n", error.status(), error.what());
    return 1;
}
