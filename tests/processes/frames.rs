//! X-ray frames are tied to ticks and are a function of volume, removed voxels and state.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

use drr_proc::ThisMachine;
use ipc_types::messages::{DrrRequest, Pose, Restores, Tick};
use ipc_types::scene::Scene;
use recorder_proc::log_file::LogFile;
use run_log::{EndReason, FrameRecord, MessageStream, ReadOptions, TimingLog, Topic, frames};
use xray::frame::{Cache, Job, render_job};
use xray::from_scene::{renderer_parameters, scene_c_arm, scene_isocentre_m};
use xray::{DrrRenderer, VolumeView};
use zerocopy::{FromBytes, IntoBytes};

use crate::common::logs::{Whole, read};
use crate::common::program::{Ended, LIMIT, Place, succeed, trabecula};
use crate::common::scenes;
use crate::languages::clients;
use crate::strays::{answer_here, joined, stopped};

pub fn frames_of(ended: &Ended) -> Vec<FrameRecord> {
    frames(&LogFile::at(ended.folder.join("run.mcap")), ReadOptions::default())
        .unwrap()
        .map(Result::unwrap)
        .collect()
}

#[test]
fn lockstep_frames_show_the_scheduled_ticks_and_repeat_to_the_pixel() {
    let (first, second) = (Place::new(), Place::new());
    let runs = [&first, &second].map(|place| place.complete(&scenes::drill("lockstep", 1.05)));
    let [a, b] = runs.each_ref().map(frames_of);
    // 10 Hz at 1 ms: every 100 ticks; the last state is shown as well.
    let ticks: Vec<u64> = a.iter().map(|frame| frame.frame.tick).collect();
    assert_eq!(ticks, [0, 100, 200, 300, 400, 500, 600, 700, 800, 900, 1000, 1050]);
    let log = read(&runs[0].folder);
    for frame in &a {
        let removed = match frame.frame.tick {
            0 => 0,
            tick => log.ticks[tick as usize - 1].state.removed_total,
        };
        assert_eq!(frame.frame.removed_total, removed);
        assert!(frame.pixels.len() == 64 * 64 * 2 && frame.frame.pixel_hash != [0; 2]);
    }
    let hashes =
        |frames: &[FrameRecord]| frames.iter().map(|frame| frame.frame.pixel_hash).collect::<Vec<_>>();
    assert_eq!(hashes(&a), hashes(&b));
    assert!(a == b);
}

/// Returns the voxels removed up to a tick, according to the log.
fn removed_until(log: &Whole, tick: u64) -> Vec<u32> {
    log.ticks
        .iter()
        .filter(|record| record.state.tick <= tick)
        .flat_map(|record| record.removed.clone())
        .collect()
}

#[test]
fn drilled_voxels_are_gone_in_the_frames() {
    let place = Place::new();
    let file = place.path("block.nrrd");
    succeed(&[&"phantom", &"block", &"-o", &file, &"--spacing-mm", &"0.5"]);
    // The block of the file begins at z = -12.25 mm; the burr is 0.75 mm in front of it.
    let text = scenes::drill_in_file("lockstep", 1.2, "block.nrrd")
        .replace("[0.0, 0.0, -34.0]", "[0.0, 0.0, -16.25]")
        .replace("[0.0, 0.0, -20.0]", "[0.0, 0.0, -5.0]");
    let ended = place.complete(&text);
    let scene = Scene::parse(&text, &place.path("scene.toml")).unwrap();
    let volume = volume_io::read(&file).unwrap();
    let view = VolumeView::try_from(&volume).unwrap();
    let drr = scene.drr.as_ref().unwrap();
    let log = read(&ended.folder);
    let last = frames_of(&ended).pop().unwrap();
    let state = log.ticks.last().unwrap().state;
    assert!(state.removed_total > 100, "only {} voxels drilled", state.removed_total);
    let rendered = |removed: Vec<u32>| {
        let job = Job {
            state: Box::new(state),
            restores: Restores::Nothing,
            removed,
            sequence: last.frame.sequence,
            request_id: 0,
            c_arm: scene_c_arm(drr).unwrap(),
            cache: Cache::Follows,
            isocentre_m: scene_isocentre_m(&scene),
            notch: drr.notch,
            noise_seed: scene.run.seed,
            radii: ipc_types::scene::STANDARD_RADII,
            holder: scene.arm.holder(),
            around: Default::default(),
        };
        let mut renderer =
            DrrRenderer::new(&view, renderer_parameters(drr, scene.tolerance.as_ref()), &ThisMachine)
                .unwrap();
        render_job(&mut renderer, &view, &job).unwrap().frame.pixel_hash
    };
    // A new renderer that receives everything at once sees the same as the process after many small steps.
    let removed = removed_until(&log, state.tick);
    assert_eq!(removed.len() as u64, state.removed_total);
    assert_eq!(rendered(removed), last.frame.pixel_hash);
    assert_ne!(rendered(Vec::new()), last.frame.pixel_hash, "the drilled voxels would be there");
}

/// Rotates the C-arm of the image-guided scene about the patient's long axis.
fn turned(angle_deg: f64) -> Pose {
    let (s, c) = (0.5 * angle_deg.to_radians()).sin_cos();
    let half = core::f64::consts::FRAC_1_SQRT_2;
    Pose { position_m: [0.0, 0.0, -0.045], orientation_xyzw: [-c * half, -s * half, s * half, c * half] }
}

/// A batch of poses for one tick is answered in the order of the requests, and the scheduled frames equal
/// those of a run without it.
#[test]
fn a_batch_of_poses_is_answered_in_order_and_leaves_the_scheduled_frames_alone() {
    let text = std::fs::read_to_string(clients().join("scenes/image_guided.toml")).unwrap();
    let text = text.replace("rate_hz = 0.0 ", "rate_hz = 100.0 ");
    let scheduled = [0, 6].map(|batch| {
        let place = Place::new();
        let run = place.start(&text);
        let mut client = joined(&run, "mine");
        for step in 0..45 {
            let tick = client.wait_state(LIMIT).unwrap().tick;
            // Halfway between two scheduled frames, and at one.
            if step == 5 || step == 20 {
                let poses = (0..batch).map(|i| turned(12.0 * f64::from(i)));
                let asked: Vec<u64> =
                    poses.map(|pose| client.request_frame(Some(&pose), tick).unwrap()).collect();
                let mut last = 0;
                for (request, i) in asked.into_iter().zip(0..) {
                    let frame = client.wait_frame(request, LIMIT).unwrap().frame;
                    assert!(frame.tick == tick && frame.sequence > last);
                    // Frontal means that the source is on +y.
                    let angle = f64::atan2(-frame.geometry.source_m[0], frame.geometry.source_m[1]);
                    assert!((angle.to_degrees() - 12.0 * f64::from(i)).abs() < 1e-9, "{angle}");
                    last = frame.sequence;
                }
            }
            answer_here(&mut client);
        }
        let ended = stopped(run, client, ());
        let frames = frames_of(&ended);
        assert_eq!(frames.iter().filter(|frame| frame.frame.request_id != 0).count(), 2 * batch as usize);
        let shown = frames.iter().filter(|frame| frame.frame.request_id == 0 && frame.frame.tick <= 40);
        shown.map(|frame| (frame.frame.tick, frame.frame.pixel_hash)).collect::<Vec<_>>()
    });
    assert_eq!(scheduled[0].iter().map(|(tick, _)| *tick).collect::<Vec<u64>>(), [0, 10, 20, 30, 40]);
    assert_eq!(scheduled[0], scheduled[1]);
}

/// Rewrites the timing lane with these requests and nothing else.
fn write_requests(timing: &Path, requests: impl Iterator<Item = DrrRequest>) {
    let stream = MessageStream::open(&LogFile::at(timing), ReadOptions::default()).unwrap();
    let header = stream.header().clone();
    drop(stream);
    let mut log = TimingLog::create(File::create(timing).unwrap(), &header).unwrap();
    for request in requests {
        log.message(Topic::DrrRequest, Tick(request.tick), request.as_bytes()).unwrap();
    }
    log.finish(EndReason::Completed, &BTreeMap::new()).unwrap();
}

/// Regression: a request that was sent before the renderer listened was lost, and its client waited until the
/// run gave up. Other parts still start here, so the renderer has the CT to read first.
#[test]
fn a_request_that_comes_before_the_renderer_is_answered() {
    let text = std::fs::read_to_string(clients().join("scenes/image_guided.toml")).unwrap();
    for _ in 0..4 {
        let place = Place::new();
        let run = place.start(&text);
        let mut client = joined(&run, "mine");
        let asked = client.request_frame(Some(&turned(30.0)), 0).unwrap();
        assert_eq!(client.wait_frame(asked, LIMIT).unwrap().frame.request_id, asked);
        stopped(run, client, ());
    }
}

/// Regression: a replay compared the first 65,536 requests with their frames and silently compared later ones
/// with their own replies.
#[test]
fn a_request_behind_a_hundred_thousand_others_is_compared_with_its_frame() {
    let place = Place::new();
    let text = std::fs::read_to_string(clients().join("scenes/image_guided.toml")).unwrap();
    let run = place.start(&text);
    let mut client = joined(&run, "mine");
    let tick = client.wait_state(LIMIT).unwrap().tick;
    let asked = client.request_frame(Some(&turned(30.0)), tick).unwrap();
    client.wait_frame(asked, LIMIT).unwrap();
    answer_here(&mut client);
    let ended = stopped(run, client, ());
    let timing = ended.folder.join("timing.mcap");
    let mut stream = MessageStream::open(&LogFile::at(&timing), ReadOptions::default()).unwrap();
    let mut request = None;
    while let Some(message) = stream.next_message().unwrap() {
        if message.known == Some(Topic::DrrRequest) {
            request = Some(DrrRequest::read_from_bytes(message.body).unwrap());
        }
    }
    let request = request.unwrap();
    let replayed = || trabecula(&[&"replay", &ended.folder, &"--frames"]);
    let others = (1..=100_000).map(|n| DrrRequest { request_id: request.request_id ^ n, ..request });
    write_requests(&timing, others.clone().chain([request]));
    let done = replayed();
    assert!(done.code == Some(0) && !done.out.contains("no request"), "{}{}", done.out, done.err);

    let mut other = request;
    other.geometry.source_m[1] += 1e-3;
    write_requests(&timing, others.chain([other]));
    let done = replayed();
    assert_eq!(done.code, Some(1), "{}{}", done.out, done.err);
    assert!(done.err.contains("geometry.source_m[1]"), "{}", done.err);

    write_requests(&timing, std::iter::empty());
    let done = replayed();
    assert!(done.code == Some(0), "{}{}", done.out, done.err);
    assert!(done.out.contains("1 on-demand frames have no request in timing.mcap"), "{}", done.out);
}
