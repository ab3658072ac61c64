"""Films: pictures become H.264 segments, and segments one MP4 without encoding again.

A segment depends on its own pictures only (closed groups of pictures, constant rate factor), so a changed picture
encodes its segment again and nothing else. Colours are BT.709, limited range, converted as such and tagged as such.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from render.errors import InvalidFileError
from render.parameters import MovieParameters
from render.pictures import read_rgb8

if TYPE_CHECKING:
    import av

SEGMENT_FRAMES = 30
"""Pictures a segment: a changed picture costs half a second of film at 60 fps."""

_LARGEST_RATE_DENOMINATOR = 1001
"""Of the frame rates in use, 24000/1001 and its kin have the largest denominator."""

_X264_PARAMETERS = "open-gop=0:cpu-independent=1"
"""cpu-independent: the same bits on every processor, and on one: the SIMD code of macroblock-tree rate control reads
memory past the end of narrow pictures, whose content is random."""


def encode_segment(
    pictures: Sequence[Path], output: Path, *, fps: float, parameters: MovieParameters, threads: int = 1
) -> None:
    """Encode pictures, one a frame; the same pixels, parameters and threads give the same bytes.

    Args:
        pictures: PNG files of one even size, in order.
        output: the MP4 to write.
        fps: frames a second [1/s].
        parameters: quality and speed.
        threads: of the encoder; part of what decides the bytes.

    Raises:
        InvalidFileError: a picture is damaged, of another size than the first, or of an odd size.
        ValueError: there are no pictures.
    """
    import av

    if not pictures:
        raise ValueError("a segment needs at least one picture")
    rate = frame_rate(fps)
    first = read_rgb8(pictures[0])
    height, width, _ = first.shape
    if width % 2 or height % 2:
        raise InvalidFileError(
            pictures[0], f"is {width}x{height} pixels, but H.264 needs an even width and height: change the resolution"
        )
    with av.open(str(output), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        options = {"crf": str(parameters.crf), "preset": parameters.preset, "x264-params": _X264_PARAMETERS}
        stream = container.add_stream("libx264", rate=rate, options=options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        encoder = stream.codec_context
        encoder.time_base = 1 / rate
        encoder.gop_size = SEGMENT_FRAMES
        encoder.thread_count = threads
        _tag_bt709(encoder)
        for index, pixels in enumerate(_pixels(pictures, first)):
            frame = _to_yuv(pixels)
            frame.pts, frame.time_base = index, 1 / rate
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def join_segments(segments: Sequence[Path], output: Path) -> None:
    """Put segments behind each other by copying their packets; frame n of the film is at n / fps exactly.

    Args:
        segments: MP4 files by `encode_segment` with the same parameters, in order.
        output: the MP4 to write.

    Raises:
        InvalidFileError: a segment is damaged, or was encoded with other parameters than the first.
        ValueError: there are no segments.
    """
    import av

    if not segments:
        raise ValueError("a film needs at least one segment")
    delay = max(_reorder_delay(segment) for segment in segments)
    with (
        av.open(str(output), "w", format="mp4", options={"movflags": "+faststart"}) as film,
        _opened(segments[0]) as first,
    ):
        template = first.streams.video[0]
        stream = film.add_stream_from_template(template)
        stream.time_base = template.time_base
        ticks = _ticks_per_frame(segments[0], template)
        frame_count = 0
        for segment in segments:
            with _opened(segment) as container:
                source = container.streams.video[0]
                if _encoding(source) != _encoding(template):
                    raise InvalidFileError(segment, f"was encoded otherwise than {segments[0]}")
                packets = _packets(segment, source)
                start = frame_count
                for packet in packets:
                    packet.pts = packet.pts + start * ticks
                    packet.dts = (frame_count - delay) * ticks
                    packet.stream = stream
                    film.mux(packet)
                    frame_count += 1


def validate_movie(path: Path, frames: int, *, see: Callable[[NDArray[np.uint8]], None] | None = None) -> None:
    """Decode a film and count its frames.

    Args:
        path: an MP4 by `encode_segment` or `join_segments`.
        frames: how many it must have.
        see: gets the luma of each frame, (height, width), in order.

    Raises:
        InvalidFileError: it cannot be decoded, has another number of frames, or they are not evenly spaced.
        OSError: it cannot be read.
    """
    import av

    count = 0
    with _opened(path) as container:
        stream = container.streams.video[0]
        stream.codec_context.options = {"err_detect": "explode"}
        spacing = 1 / Fraction(stream.average_rate or 1)
        try:
            for frame in container.decode(stream):
                time = None if frame.pts is None else frame.pts * Fraction(frame.time_base)
                if time != count * spacing:
                    raise InvalidFileError(path, f"frame {count} is at {time} s instead of {count * spacing} s")
                if frame.is_corrupt:
                    raise InvalidFileError(path, f"frame {count} is damaged")
                if see is not None:
                    see(frame.to_ndarray(format="gray"))
                count += 1
        except av.FFmpegError as error:
            raise InvalidFileError(path, f"cannot be decoded after {count} frames: {error}") from error
    if count != frames:
        raise InvalidFileError(path, f"has {count} frames, expected {frames}")


def frame_rate(fps: float) -> Fraction:
    """Frames a second as the fraction that a film stores; 23.976 is 2997/125."""
    return Fraction(fps).limit_denominator(_LARGEST_RATE_DENOMINATOR)


def _pixels(pictures: Sequence[Path], first: NDArray[np.uint8]) -> Iterator[NDArray[np.uint8]]:
    yield first
    for path in pictures[1:]:
        pixels = read_rgb8(path)
        if pixels.shape != first.shape:
            (height, width, _), (first_height, first_width, _) = pixels.shape, first.shape
            raise InvalidFileError(
                path, f"is {width}x{height} pixels, but {pictures[0].name} is {first_width}x{first_height}"
            )
        yield pixels


def _to_yuv(pixels: NDArray[np.uint8]) -> av.VideoFrame:
    import av
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc, Interpolation

    # Without a destination the conversion is BT.601. BITEXACT: the same pixels on every processor.
    return av.VideoFrame.from_ndarray(pixels, format="rgb24").reformat(
        format="yuv420p",
        dst_colorspace=Colorspace.ITU709,
        dst_color_range=ColorRange.MPEG,
        dst_color_primaries=ColorPrimaries.BT709,
        dst_color_trc=ColorTrc.BT709,
        interpolation=Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.BITEXACT,
        threads=1,
    )


def _tag_bt709(encoder: Any) -> None:
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

    encoder.color_primaries = ColorPrimaries.BT709
    encoder.color_trc = ColorTrc.BT709
    encoder.colorspace = Colorspace.ITU709
    encoder.color_range = ColorRange.MPEG


def _opened(path: Path) -> Any:
    import av

    try:
        container = av.open(str(path), format="mp4")
    except av.FFmpegError as error:
        if isinstance(error, FileNotFoundError | PermissionError):
            raise
        raise InvalidFileError(path, f"is not an MP4 film: {error}") from error
    if len(container.streams.video) != 1:
        container.close()
        raise InvalidFileError(path, "has no picture track")
    return container


def _encoding(stream: Any) -> tuple[object, ...]:
    """What must be equal for packets of two files to share a track."""
    context = stream.codec_context
    return context.name, context.extradata, context.width, context.height, stream.time_base, stream.average_rate


def _ticks_per_frame(path: Path, stream: Any) -> int:
    ticks = 1 / (Fraction(stream.average_rate) * Fraction(stream.time_base))
    if ticks.denominator != 1:
        raise InvalidFileError(path, f"a frame does not last a whole number of ticks: {ticks}")
    return int(ticks)


def _packets(path: Path, stream: Any) -> Iterator[Any]:
    """Packets with a picture in them, in decoding order; the last, empty one flushes decoders."""
    import av

    try:
        for packet in stream.container.demux(stream):
            if packet.size:
                yield packet
    except av.FFmpegError as error:
        raise InvalidFileError(path, f"cannot be read: {error}") from error


def _reorder_delay(path: Path) -> int:
    """By how many frames decoding runs ahead of showing; a segment of one or two frames needs no delay."""
    with _opened(path) as container:
        stream = container.streams.video[0]
        first = next(_packets(path, stream), None)
        if first is None or first.dts is None:
            raise InvalidFileError(path, "has no frames")
        return int(-first.dts // _ticks_per_frame(path, stream))
