//! X-ray frames as images with their cameras.
//!
//! A frame is usually seen from the detector's side, as a radiograph hangs, and its focal length fx is then
//! negative. OpenCV and RViz expect positive focal lengths, so such an image is sent mirrored, as a camera at
//! the source sees it, with the matching camera matrix. The frame `c_arm` is the same for both.

use std::borrow::Cow;

use messages::{Frame, Pose};
use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use simulation::pose;

use crate::msg::{
    CameraInfo, Header, Image, PointStamped, RegionOfInterest, TfMessage, Time, Vector3 as RosVector,
};
use crate::outgoing::{Outgoing, push, transform};
use crate::robot::{FrameInParent, WORLD, isometry};
use crate::topics::Output;

/// The C-arm's optical frame: +z from the source to the detector.
pub const C_ARM_FRAME: &str = "c_arm";
/// Larger images are reduced, bytes: a subscriber of Fast DDS has a receive buffer of 212 992 bytes unless
/// its profile or its machine is configured otherwise, and loses fragments of larger ones.
pub const MAX_IMAGE_BYTES: usize = 180_000;

/// Encoding of images.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ImageForm {
    /// `mono16` up to [`MAX_IMAGE_BYTES`], else `mono8`, else `mono8` with every two by two pixels (four by
    /// four, and so on) merged into one.
    #[default]
    Fitting,
    /// Always `mono16`.
    Full,
}

/// Returns whether pixels have 16 bits, and the side in pixels of the squares to merge.
fn reduction(columns: usize, rows: usize, form: ImageForm) -> (bool, usize) {
    let pixels = columns * rows;
    if form == ImageForm::Full || 2 * pixels <= MAX_IMAGE_BYTES {
        return (true, 1);
    }
    let mut side = 1;
    while (columns / side) * (rows / side) > MAX_IMAGE_BYTES {
        side *= 2;
    }
    (false, side)
}

/// Converts a frame to image, camera, burr and transform; empty if its pixels do not match its announced
/// size. The burr's front is `front_m` before its centre.
pub fn of_frame(frame: &Frame, pixels: &[u16], form: ImageForm, front_m: f64) -> Vec<Outgoing> {
    let (columns, rows) = (frame.geometry.columns as usize, frame.geometry.rows as usize);
    if pixels.len() != columns * rows || pixels.is_empty() {
        return Vec::new();
    }
    let stamp = Time::of_simulated(frame.sim_time_s);
    let header = Header { stamp, frame_id: C_ARM_FRAME.into() };
    let (is_wide, side) = reduction(columns, rows, form);
    let (width, height) = (columns / side, rows / side);
    let pixels = &as_seen_from_source(frame, pixels);
    let data: Vec<u8> = if is_wide {
        pixels.iter().flat_map(|pixel| pixel.to_le_bytes()).collect()
    } else {
        reduced(pixels, columns, width, height, side)
    };
    let bytes = if is_wide { 2 } else { 1 };
    let (width, height) = (as_u32(width), as_u32(height));
    let encoding = if is_wide { "mono16" } else { "mono8" }.to_owned();
    let image =
        Image { header: header.clone(), height, width, encoding, is_bigendian: 0, step: width * bytes, data };
    let mut out = Vec::new();
    push(&mut out, Output::CArmImage, &image);
    let info = camera(frame, header, width, height, side);
    push(&mut out, Output::CArmInfo, &info);
    if let Some(point) = burr_tip(frame, &info, front_m) {
        push(&mut out, Output::BurrTip, &PointStamped { header: info.header, point });
    }
    let placed =
        FrameInParent { parent: WORLD.into(), child: C_ARM_FRAME.into(), pose: t_world_camera(frame) };
    push(&mut out, Output::Tf, &TfMessage { transforms: vec![transform(placed, stamp)] });
    out
}

/// Returns whether columns and rows are mirrored against the camera's axes.
fn mirrored(frame: &Frame) -> [bool; 2] {
    [frame.projection.intrinsics[0] < 0.0, frame.projection.intrinsics[4] < 0.0]
}

/// Returns the pixels with columns along the camera's +x and rows along its +y.
fn as_seen_from_source<'a>(frame: &Frame, pixels: &'a [u16]) -> Cow<'a, [u16]> {
    let [columns, rows] = mirrored(frame);
    let mut seen = Cow::Borrowed(pixels);
    if columns {
        seen.to_mut().chunks_exact_mut(frame.geometry.columns as usize).for_each(<[u16]>::reverse);
    }
    if rows {
        let lines = seen.rchunks_exact(frame.geometry.columns as usize);
        seen = Cow::Owned(lines.flatten().copied().collect());
    }
    seen
}

fn as_u32(count: usize) -> u32 {
    u32::try_from(count).unwrap_or(u32::MAX)
}

/// Returns the upper eight bits of the means of `side` by `side` pixels.
fn reduced(pixels: &[u16], columns: usize, width: usize, height: usize, side: usize) -> Vec<u8> {
    let mut data = Vec::with_capacity(width * height);
    for row in 0..height {
        for column in 0..width {
            let mut sum = 0_u64;
            for line in 0..side {
                let first = (row * side + line) * columns + column * side;
                sum += pixels[first..first + side].iter().map(|pixel| u64::from(*pixel)).sum::<u64>();
            }
            data.push((sum / (side * side) as u64 / 256) as u8);
        }
    }
    data
}

fn camera(frame: &Frame, header: Header, width: u32, height: u32, side: usize) -> CameraInfo {
    let mut k = frame.projection.intrinsics;
    let [columns, rows] = mirrored(frame);
    if columns {
        (k[0], k[2]) = (-k[0], f64::from(frame.geometry.columns) - 1.0 - k[2]);
    }
    if rows {
        (k[4], k[5]) = (-k[4], f64::from(frame.geometry.rows) - 1.0 - k[5]);
    }
    if side > 1 {
        // Pixel centres are at integers: the centre of the first large pixel is (side - 1) / 2 from that of
        // the first small one.
        let (scale, shift) = (1.0 / side as f64, (side as f64 - 1.0) / 2.0);
        k[0] *= scale;
        k[1] *= scale;
        k[4] *= scale;
        k[2] = (k[2] - shift) * scale;
        k[5] = (k[5] - shift) * scale;
    }
    let mut p = [0.0; 12];
    for row in 0..3 {
        p[4 * row..4 * row + 3].copy_from_slice(&k[3 * row..3 * row + 3]);
    }
    CameraInfo {
        header,
        height,
        width,
        distortion_model: "plumb_bob".into(),
        d: vec![0.0; 5],
        k,
        r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p,
        binning_x: 0,
        binning_y: 0,
        roi: RegionOfInterest::default(),
    }
}

/// Returns the front of the burr: column and row in the sent image, pixels, and its depth, m. `None` if it is
/// behind the source.
fn burr_tip(frame: &Frame, info: &CameraInfo, front_m: f64) -> Option<RosVector> {
    let front = isometry(&frame.t_world_burr) * Point3::new(0.0, 0.0, front_m);
    let seen = isometry(&t_world_camera(frame)).inverse_transform_point(&front);
    let k = &info.k;
    let at = |row: usize| (k[3 * row] * seen.x + k[3 * row + 1] * seen.y) / seen.z + k[3 * row + 2];
    (seen.z > 0.0).then(|| RosVector { x: at(0), y: at(1), z: seen.z })
}

/// Pose of the camera in the world, from x_camera = R x_world + t.
fn t_world_camera(frame: &Frame) -> Pose {
    let rotation = Matrix3::from_row_slice(&frame.projection.rotation);
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let translation = Translation3::from(Vector3::from(frame.projection.translation_m));
    pose(&Isometry3::from_parts(translation, turn).inverse())
}

#[cfg(test)]
mod tests {
    use zerocopy::FromZeros;

    use super::*;

    #[test]
    fn an_image_is_sent_as_it_is_or_as_small_as_it_must_be() {
        assert_eq!(reduction(256, 256, ImageForm::Fitting), (true, 1));
        assert_eq!(reduction(384, 384, ImageForm::Fitting), (false, 1));
        assert_eq!(reduction(512, 512, ImageForm::Fitting), (false, 2));
        assert_eq!(reduction(2048, 2048, ImageForm::Fitting), (false, 8));
        assert_eq!(reduction(2048, 2048, ImageForm::Full), (true, 1));
    }

    #[test]
    fn a_small_image_shows_the_means_and_its_camera_the_same_place() {
        let mut frame = Frame::new_zeroed();
        (frame.geometry.columns, frame.geometry.rows) = (4, 2);
        let pixels = [0, 256, 512, 512, 256, 512, 512, 512];
        assert_eq!(reduced(&pixels, 4, 2, 1, 2), [1, 2]);
        frame.projection.intrinsics = [-1000.0, 0.0, 1.5, 0.0, 1000.0, 0.5, 0.0, 0.0, 1.0];
        let info = camera(&frame, Header::default(), 2, 1, 2);
        // The optical axis meets the middle of the image: between the two large pixels.
        assert_eq!((info.k[0], info.k[2], info.k[5]), (500.0, 0.5, 0.0));
        assert_eq!(info.p[..4], [500.0, 0.0, 0.5, 0.0]);
    }

    /// Regression: images were sent with negative focal lengths, which OpenCV and RViz do not expect.
    #[test]
    fn a_point_has_the_same_pixel_in_the_sent_image_as_in_the_frame_and_focal_lengths_are_positive() {
        let (columns, rows) = (6, 4);
        // Cameras with either sign of fx and fy, and no symmetry.
        for [fx, fy] in [[900.0, 800.0], [-900.0, 800.0], [900.0, -800.0], [-900.0, -800.0]] {
            let mut frame = Frame::new_zeroed();
            (frame.geometry.columns, frame.geometry.rows) = (columns, rows);
            frame.projection.intrinsics = [fx, 0.0, 2.25, 0.0, fy, 1.75, 0.0, 0.0, 1.0];
            let pixels: Vec<u16> = (0..columns * rows).map(|pixel| pixel as u16).collect();
            let seen = as_seen_from_source(&frame, &pixels);
            let info = camera(&frame, Header::default(), columns, rows, 1);
            assert!(info.k[0] == 900.0 && info.k[4] == 800.0, "{:?}", info.k);
            for (index, pixel) in pixels.iter().enumerate() {
                // The ray through the pixel's centre in the frame, and its pixel in the sent image.
                let [u, v] = [index as u32 % columns, index as u32 / columns].map(f64::from);
                let (x, y) = ((u - 2.25) / fx, (v - 1.75) / fy);
                let (column, row) = (info.k[0] * x + info.k[2], info.k[4] * y + info.k[5]);
                assert!((column - column.round()).abs() < 1e-9 && (row - row.round()).abs() < 1e-9);
                let found = seen[row.round() as usize * columns as usize + column.round() as usize];
                assert_eq!(found, *pixel, "fx {fx}, fy {fy}: {column} {row}");
            }
        }
    }

    /// A camera at the origin that looks along +z, seen from the detector's side and merged two by two.
    #[test]
    fn the_burrs_front_is_where_the_sent_image_has_it() {
        let mut frame = Frame::new_zeroed();
        (frame.geometry.columns, frame.geometry.rows) = (100, 80);
        frame.projection.intrinsics = [-1000.0, 0.0, 40.5, 0.0, 1000.0, 30.5, 0.0, 0.0, 1.0];
        frame.projection.rotation = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        frame.t_world_burr = Pose { position_m: [0.01, 0.02, 0.997], orientation_xyzw: [0.0, 0.0, 0.0, 1.0] };
        let at = |side: usize| {
            let (width, height) = (100 / side as u32, 80 / side as u32);
            burr_tip(&frame, &camera(&frame, Header::default(), width, height, side), 3e-3).unwrap()
        };
        // In the frame: column 40.5 - 10, row 30.5 + 20; mirrored: 99 - 30.5.
        let near = |found: RosVector, x: f64, y: f64| {
            assert!((found.x - x).abs() < 1e-9 && (found.y - y).abs() < 1e-9, "{found:?}");
            assert!((found.z - 1.0).abs() < 1e-12, "{found:?}");
        };
        near(at(1), 68.5, 50.5);
        near(at(2), 34.0, 25.0);
        frame.t_world_burr.position_m[2] = -1.0;
        assert_eq!(burr_tip(&frame, &camera(&frame, Header::default(), 100, 80, 1), 3e-3), None);
    }

    #[test]
    fn a_frame_whose_pixels_are_missing_is_no_image() {
        let mut frame = Frame::new_zeroed();
        (frame.geometry.columns, frame.geometry.rows) = (4, 4);
        assert!(of_frame(&frame, &[0; 15], ImageForm::Fitting, 0.0).is_empty());
    }
}
