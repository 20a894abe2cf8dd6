"""Image sources: times, dropped frames, files."""

from __future__ import annotations

import numpy as np
import pytest

from torch_ekm.exceptions import DescriptionError, ParameterError
from torch_ekm.sensing import (
    ImageFolder,
    MarkerBoard,
    MarkerTracker,
    StreamOptions,
    TrackStatus,
    VideoCapture,
)
from torch_ekm.simulation import CardScene, PlacedCard, SimulatedCamera, SimulatedVideo

cv2 = pytest.importorskip("cv2")


@pytest.fixture
def moving(pose_of):
    """A scene that moves 10 mm a second."""
    boards = MarkerBoard(0), MarkerBoard(4)
    return lambda t: CardScene(
        (
            PlacedCard(boards[0], pose_of(-0.05, tilt_deg=30)),
            PlacedCard(boards[1], pose_of(0.04 + 0.01 * t, tilt_deg=30)),
        )
    )


def test_a_frame_shows_the_scene_of_its_time(moving, simulated):
    video = SimulatedVideo(simulated, moving, StreamOptions(rate=20, latency=0.12))
    frame = video.frame(17)
    assert (frame.time, frame.arrival) == pytest.approx((0.85, 0.97))
    tracker = MarkerTracker(simulated.camera, MarkerBoard(0), MarkerBoard(4))
    now, then = (tracker.track(video.frame(k).image).object.position[0] for k in (20, 17))
    assert now - then == pytest.approx(0.0015, abs=2e-4)


def test_frames_do_not_depend_on_what_was_looked_at(moving, simulated):
    options = StreamOptions(seed=5, dropped=0.3)
    one = [frame for frame in SimulatedVideo(simulated, moving, options, n_frames=6)]
    other = SimulatedVideo(simulated, moving, options)
    for k in (4, 1):
        image = other.frame(k).image
        assert (image is None) == (one[k].image is None)
        if image is not None:
            np.testing.assert_array_equal(image, one[k].image)


def test_dropped_frames_come_at_the_stated_rate(simulated):
    small = SimulatedCamera(simulated.camera)
    video = SimulatedVideo(small, lambda t: CardScene(), StreamOptions(dropped=0.25, latency=0.0))
    small.render = lambda scene, generator: np.zeros((1, 1), np.uint8)
    dropped = np.array([video.frame(k).image is None for k in range(2000)])
    assert dropped.mean() == pytest.approx(0.25, abs=0.03)


def test_hidden_frames_are_noticed(moving, simulated):
    video = SimulatedVideo(simulated, moving, StreamOptions(hidden=0.5, seed=2), n_frames=12)
    tracker = MarkerTracker(simulated.camera, MarkerBoard(0), MarkerBoard(4))
    status = [tracker.track(frame.image).status for frame in video]
    assert {TrackStatus.OK, TrackStatus.PALM_HIDDEN, TrackStatus.OBJECT_HIDDEN} == set(status)


def test_images_from_a_folder(moving, simulated, tmp_path):
    for frame in SimulatedVideo(simulated, moving, n_frames=3):
        cv2.imwrite(str(tmp_path / f"{frame.index:03d}.png"), frame.image)
    (tmp_path / "003.png").write_bytes(b"not an image")
    source = ImageFolder(tmp_path, options=StreamOptions(rate=10, latency=0.02))
    assert len(source) == 4
    frames = list(source)
    for frame, original in zip(frames, SimulatedVideo(simulated, moving, n_frames=3), strict=False):
        np.testing.assert_array_equal(frame.image, original.image)
        assert frame.arrival - frame.time == pytest.approx(0.02)
    assert [frame.time for frame in frames] == pytest.approx([0, 0.1, 0.2, 0.3])
    assert frames[3].image is None
    with pytest.raises(DescriptionError, match="no such folder"):
        ImageFolder(tmp_path / "nowhere")
    with pytest.raises(DescriptionError, match="tiff"):
        ImageFolder(tmp_path, "*.tiff")


def test_a_video_file_is_tracked(moving, simulated, tmp_path):
    path = str(tmp_path / "look.avi")
    writer = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*"MJPG"), 20, (640, 480), True)
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MJPG video")
    for frame in SimulatedVideo(simulated, moving, n_frames=4):
        writer.write(cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR))
    writer.release()
    source = VideoCapture(path)
    tracker = MarkerTracker(simulated.camera, MarkerBoard(0), MarkerBoard(4))
    frames = list(source)
    source.close()
    assert len(frames) == 4
    assert all(tracker.track(frame.image).ok for frame in frames)
    with pytest.raises(DescriptionError, match="cannot open"):
        VideoCapture(str(tmp_path / "nothing.avi"))


def test_a_source_without_end_is_read_frame_by_frame(moving, simulated):
    frames = iter(SimulatedVideo(simulated, moving))
    assert [next(frames).index for _ in range(2)] == [0, 1]


def test_impossible_streams_are_refused(moving, simulated):
    for bad in ({"rate": 0.0}, {"latency": -0.1}, {"dropped": 1.0}, {"hidden": -0.2}):
        with pytest.raises(ParameterError, match=next(iter(bad))):
            StreamOptions(**bad)
    with pytest.raises(ParameterError, match="index"):
        SimulatedVideo(simulated, moving).frame(-1)
