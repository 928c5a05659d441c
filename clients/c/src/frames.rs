//! X-ray frames and the CT volume, in place.

use std::time::{Duration, Instant};

use ipc_types::messages::layout::Message;
use ipc_types::messages::services;
use ipc_types::messages::{
    CArmGeometry, DrrReply, DrrRequest, DrrStatus, Frame, GeometryChoice, ImagePrefix, Pose, Volume,
};
use ipc_types::ports::{ReceivedMessage, Subscriber};
use ipc_types::scene::Drr;
use ipc_types::session::Reader;
use zerocopy::FromBytes;

use crate::client::{Client, Requests, new_request_id, poll_until, put};
use crate::error::ClientError;

/// Poll interval while waiting for the volume.
const RETRY_TIME: Duration = Duration::from_millis(2);
/// Time after the end of a run within which its last frames may arrive.
const LAST_FRAMES: Duration = Duration::from_secs(1);

const NO_PICTURE: ClientError = ClientError::Misuse("malformed frame: its pixels do not match its header");

/// A frame in shared memory.
#[derive(Debug, Clone, Copy)]
pub struct FrameView<'a> {
    /// Tick, C-arm and size.
    pub frame: &'a Frame,
    /// Intensities, row by row from the top left; 0 is black.
    pub pixels: &'a [u16],
}

/// The CT volume in shared memory.
#[derive(Debug, Clone, Copy)]
pub struct VolumeView<'a> {
    /// Geometry.
    pub volume: &'a Volume,
    /// Hounsfield units, x fastest.
    pub hu: &'a [i16],
}

impl Client {
    /// Requests a frame and returns the request's id. `t_world_c_arm` is the pose of the C-arm: its origin is
    /// the isocentre, +x runs along the image rows to the right, +y along the columns down, +z to the source;
    /// distances, pixels and pitch are the scene's. `None` uses the scene's C-arm unchanged. The frame shows
    /// the state of `tick`, or the newest one if that has passed.
    ///
    /// # Errors
    /// [`ClientError::NoDrr`], [`ClientError::BadArgument`] for an invalid pose; or a transport error.
    pub fn request_frame(&mut self, t_world_c_arm: Option<&Pose>, tick: u64) -> Result<u64, ClientError> {
        self.check_process()?;
        self.open_frames()?;
        let drr = self.scene.drr.as_ref().ok_or(ClientError::NoDrr)?;
        let geometry = t_world_c_arm.map(|pose| geometry_at(pose, drr)).transpose()?;
        let requester = DrrRequest::requester_of(self.info.controller.as_ref().map(|(_, index)| *index));
        let requests = match &mut self.requests {
            Some(requests) => requests,
            none => none.insert(Requests {
                publisher: self.session.publisher(&services::DRR_REQUEST)?,
                replies: self.session.lossless_subscriber(&services::DRR_REPLY)?,
                drr: self.session.waker(Reader::Drr)?,
                accepted: 0,
            }),
        };
        let request_id = new_request_id();
        requests.publisher.send(&DrrRequest {
            request_id,
            tick,
            requester,
            use_geometry: if geometry.is_some() { GeometryChoice::Request } else { GeometryChoice::Scene }
                .code(),
            geometry: geometry.unwrap_or_else(CArmGeometry::zeroed),
        })?;
        requests.drr.wake();
        Ok(request_id)
    }

    /// Waits for the frame of a request, or for the next frame of any kind if `request_id` is 0. Frames are
    /// queued from this client's first call of this function or [`Client::request_frame`] on, at most 64. The
    /// frame stays in shared memory, unchanged, until the next one is returned.
    ///
    /// # Errors
    /// [`ClientError::NoDrr`], [`ClientError::FrameRefused`], [`ClientError::TimedOut`],
    /// [`ClientError::Ended`] when the run is over and no frame is being rendered; or a transport error.
    pub fn wait_frame(&mut self, request_id: u64, limit: Duration) -> Result<FrameView<'_>, ClientError> {
        self.check_process()?;
        self.open_frames()?;
        let deadline = Instant::now() + limit;
        loop {
            self.check_replies(request_id)?;
            let Some(frames) = &self.frames else { return Err(ClientError::NoDrr) };
            if let Some(frame) = frames.receive()? {
                if request_id != 0 && frame.message().request_id != request_id {
                    continue;
                }
                frame_view(&frame).ok_or(NO_PICTURE)?;
                if put(&mut self.frame, frame) {
                    break;
                }
                continue;
            }
            if Instant::now() >= deadline {
                return Err(ClientError::TimedOut(limit));
            }
            let slice = deadline.min(Instant::now() + Duration::from_millis(2));
            poll_until(slice, || frames.has_message());
            self.check_frames_come(request_id)?;
        }
        self.frame.as_ref().and_then(frame_view).ok_or(NO_PICTURE)
    }

    /// Fails if the run has ended and no frame is being rendered, so that no more frames will arrive.
    fn check_frames_come(&mut self, request_id: u64) -> Result<(), ClientError> {
        let ended = self.has_ended()? && self.ended.is_some_and(|since| since.elapsed() >= LAST_FRAMES);
        let accepted = self.requests.as_ref().map_or(0, |requests| requests.accepted);
        let rendered = request_id != 0 && accepted == request_id;
        if ended && !rendered { Err(ClientError::Ended) } else { Ok(()) }
    }

    fn open_frames(&mut self) -> Result<(), ClientError> {
        if self.scene.drr.is_none() {
            return Err(ClientError::NoDrr);
        }
        if self.frames.is_none() {
            // Frames requested by others must not evict one that this client waits for.
            self.frames = Some(self.session.lossless_subscriber(&services::FRAME)?);
        }
        Ok(())
    }

    /// Takes the next reply to a request for a frame, of any program; replies are queued from this client's
    /// first request on. [`Client::wait_frame`] for a request skips those that came before.
    ///
    /// # Errors
    /// A transport error.
    pub fn next_frame_reply(&mut self) -> Result<Option<DrrReply>, ClientError> {
        self.check_process()?;
        let Some(requests) = &self.requests else { return Ok(None) };
        // The DRR process may have begun to listen only after a request.
        requests.publisher.deliver_history()?;
        Ok(requests.replies.receive()?.map(|reply| *reply.message()))
    }

    fn check_replies(&mut self, request_id: u64) -> Result<(), ClientError> {
        if request_id == 0 {
            return Ok(());
        }
        let mut refused = None;
        while let Some(reply) = self.next_frame_reply()? {
            if reply.request_id != request_id {
                continue;
            }
            match reply.status() {
                Ok(DrrStatus::Accepted) => {
                    self.requests.iter_mut().for_each(|requests| requests.accepted = request_id);
                }
                Ok(DrrStatus::Busy) => refused = Some("rejected: too many requests are waiting"),
                _ => refused = Some("refused"),
            }
        }
        let Some(how) = refused else { return Ok(()) };
        // Requests still waiting when the run ends are refused for that reason alone.
        if self.has_ended()? {
            Err(ClientError::Ended)
        } else {
            Err(ClientError::FrameRefused { request_id, how })
        }
    }

    /// Returns the CT volume at the start of the run, in place. It stays mapped as long as the client lives.
    ///
    /// # Errors
    /// [`ClientError::NoVolume`], [`ClientError::TimedOut`], [`ClientError::Ended`]; or a transport error.
    pub fn volume(&mut self, limit: Duration) -> Result<VolumeView<'_>, ClientError> {
        self.check_process()?;
        if self.scene.volume.is_none() {
            return Err(ClientError::NoVolume);
        }
        if self.volume.is_none() {
            let deadline = Instant::now() + limit;
            if self.volumes.is_none() {
                self.volumes = Some(self.session.subscriber(&services::VOLUME)?);
            }
            loop {
                self.volume = self.volumes.as_ref().map_or(Ok(None), Subscriber::receive)?;
                if self.volume.is_some() || Instant::now() >= deadline {
                    break;
                }
                if self.has_ended()? {
                    return Err(ClientError::Ended);
                }
                std::thread::sleep(RETRY_TIME);
            }
        }
        let volume = self.volume.as_ref().ok_or(ClientError::TimedOut(limit))?;
        let wrong = ClientError::Misuse("malformed volume: its voxels do not match its header");
        let hu = <[i16]>::ref_from_bytes(volume.tail()).map_err(|_| wrong)?;
        Ok(VolumeView { volume: volume.message(), hu })
    }
}

/// Returns a frame's pixels in place, or `None` if the image is invalid: its writer is another process.
pub(crate) fn frame_view(received: &ReceivedMessage<Frame>) -> Option<FrameView<'_>> {
    let frame = received.message();
    let data = received.tail().get(ImagePrefix::DESCRIPTION.size..)?;
    let pixels = <[u16]>::ref_from_bytes(data).ok()?;
    let expected = u64::from(frame.geometry.columns) * u64::from(frame.geometry.rows);
    (pixels.len() as u64 == expected).then_some(FrameView { frame, pixels })
}

/// Returns the scene's C-arm, moved to a pose.
fn geometry_at(pose: &Pose, drr: &Drr) -> Result<CArmGeometry, ClientError> {
    let [x, y, z, w] = pose.orientation_xyzw;
    let length = (x * x + y * y + z * z + w * w).sqrt();
    let is_unit = (length - 1.0).abs() < 1e-6;
    if !is_unit {
        let expected = "the length 1 of a unit quaternion";
        return Err(ClientError::BadArgument { name: "orientation_xyzw", value: length, expected });
    }
    if let Some(value) = pose.position_m.iter().find(|value| !value.is_finite()) {
        return Err(ClientError::BadArgument { name: "position_m", value: *value, expected: "metres" });
    }
    // Columns of the unit quaternion's rotation matrix.
    let row_axis = [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)];
    let column_axis = [2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)];
    let to_source = [2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)];
    let along =
        |distance_m: f64| core::array::from_fn(|axis| pose.position_m[axis] + distance_m * to_source[axis]);
    let pitch_m = drr.pixel_pitch_mm * 1e-3;
    Ok(CArmGeometry {
        source_m: along(drr.source_isocentre_mm * 1e-3),
        detector_centre_m: along((drr.source_isocentre_mm - drr.source_detector_mm) * 1e-3),
        row_axis,
        column_axis,
        pixel_pitch_m: [pitch_m, pitch_m],
        columns: drr.columns,
        rows: drr.rows,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At AP the image shows the patient's right (LPS −x) on its left and the head (+z) up, with the source
    /// behind the patient (+y).
    #[test]
    fn the_c_arm_stands_where_its_pose_says() {
        let text =
            "rate_hz = 0.0\nisocentre_mm = [0.0, 0.0, 0.0]\ncolumns = 64\nrows = 32\npixel_pitch_mm = 1.5\n";
        let scene = format!(
            "name = \"x\"\n[run]\nmode = \"lockstep\"\nduration_s = 1.0\n[volume]\nphantom = \"block\"\n\
             [tool]\nburr_start_mm = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\n\
             bend_toward = [1.0, 0.0, 0.0]\n[drr]\n{text}"
        );
        let scene = ipc_types::scene::Scene::parse(&scene, std::path::Path::new("x.toml")).unwrap();
        let drr = scene.drr.unwrap();
        // Rows along +x, columns along −z: a rotation by −90° about x, so that the C-arm's +z is the
        // patient's +y.
        let half = core::f64::consts::FRAC_1_SQRT_2;
        let pose = Pose { position_m: [0.01, 0.02, 0.03], orientation_xyzw: [-half, 0.0, 0.0, half] };
        let geometry = geometry_at(&pose, &drr).unwrap();
        let near = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(near(geometry.row_axis, [1.0, 0.0, 0.0]), "{geometry:?}");
        assert!(near(geometry.column_axis, [0.0, 0.0, -1.0]), "{geometry:?}");
        assert!(near(geometry.source_m, [0.01, 0.72, 0.03]), "{geometry:?}");
        assert!(near(geometry.detector_centre_m, [0.01, -0.28, 0.03]), "{geometry:?}");
        let bent = Pose { orientation_xyzw: [0.0, 0.0, 0.0, 1.1], ..pose };
        assert!(geometry_at(&bent, &drr).unwrap_err().to_string().contains("1.1"));
    }
}
