"""Films: pictures become segments, and segments one file without encoding again.

H.264, H.265 and AV1 in MP4, ProRes in QuickTime.

A segment depends on its own pictures only (closed groups of pictures, constant rate factor), so a changed picture
encodes its segment again and nothing else. Colours are BT.709, limited range, converted as such and tagged as such.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.errors import InvalidFileError
from render.parameters import MovieParameters
from render.pictures import Pixels, read_rgb8, read_rgb16

if TYPE_CHECKING:
    import av

SEGMENT_FRAMES = 30  # pictures a segment: a changed picture costs half a second of film at 60 fps

_LARGEST_RATE_DENOMINATOR = 1001  # of the frame rates in use, 24000/1001 and its kin have the largest denominator

_X265_PARAMETERS = f"open-gop=0:keyint={SEGMENT_FRAMES}:info=0:pools=none:frame-threads=1:log-level=error"
"""info=0: no version and options in the stream. One thread, as what several make may depend on their timing."""

_X265_REORDERED = 2
"""By how many frames decoding may run ahead of showing, with B-frames that refer to B-frames; x265 leaves the times at
which packets are decoded to chance in a segment of a frame or two."""

_SVT_AV1_PARAMETERS = "lp=1:enable-overlays=0"  # lp=1: one thread, as for x265
_SVT_AV1_SPEEDS = {"ultrafast": 12, "veryfast": 10, "fast": 9, "medium": 8, "slow": 6, "veryslow": 4}

_X264_PARAMETERS = "open-gop=0:cpu-independent=1"
"""cpu-independent: the same bits on every processor, and on one: the SIMD code of macroblock-tree rate control reads
memory past the end of narrow pictures, whose content is random."""


class _Encoder(NamedTuple):
    """FFmpeg's encoder of a codec, its label for people, pixel format, bits a channel, and muxer.

    By `tag`, of four characters, players know the codec; None: the muxer's own.
    """

    name: str
    label: str
    pixels: str
    bits: int
    container: str
    tag: str | None = None


_ENCODERS = {
    "h264": _Encoder("libx264", "H.264", "yuv420p", 8, "mp4"),
    # Players by Apple know H.265 in an MP4 by this tag alone.
    "h265": _Encoder("libx265", "H.265", "yuv420p10le", 10, "mp4", tag="hvc1"),
    "av1": _Encoder("libsvtav1", "AV1", "yuv420p10le", 10, "mp4"),
    "prores": _Encoder("prores_ks", "ProRes", "yuv422p10le", 10, "mov"),
}


def missing_encoder(codec: str) -> str | None:
    """The encoder that a codec needs and this FFmpeg lacks; None if it is there."""
    import av

    name = _ENCODERS[codec].name
    try:
        av.codec.Codec(name, "w")
    except av.codec.codec.UnknownCodecError:
        return name
    return None


def encode_segment(
    pictures: Sequence[Path], output: Path, *, fps: float, parameters: MovieParameters, threads: int = 1
) -> None:
    """Encode pictures, one a frame; the same pixels, parameters and threads give the same bytes.

    Args:
        pictures: PNG files of one even size, in order.
        output: the MP4 to write, or the QuickTime film for ProRes.
        fps: frames a second [1/s].
        parameters: codec, quality and speed.
        threads: of H.264's encoder; part of what decides the bytes.

    Raises:
        InvalidFileError: a picture is damaged, of another size than the first, or of an odd size.
        ValueError: there are no pictures.
    """
    if not pictures:
        raise ValueError("a segment needs at least one picture")
    read = read_rgb8 if _ENCODERS[parameters.codec].bits == 8 else read_rgb16
    first = read(pictures[0])
    height, width, _ = first.shape
    if width % 2 or height % 2:
        raise InvalidFileError(
            pictures[0],
            f"is {width}x{height} pixels, but {_ENCODERS[parameters.codec].label} needs an even width and height: "
            "change the resolution",
        )
    encode_frames(
        _pixels(pictures, first, read), (width, height), output, fps=fps, parameters=parameters, threads=threads
    )


def encode_frames(
    frames: Iterable[Pixels],
    size: tuple[int, int],
    output: Path,
    *,
    fps: float,
    parameters: MovieParameters,
    threads: int = 1,
) -> None:
    """Encode frames as they come, so that their number takes no memory.

    Args:
        frames: pixels of each frame, (height, width, 3), uint8 or uint16; at least one.
        size: even width and height [pixels].
        output, fps, parameters, threads: as for `encode_segment`.
    """
    import av

    rate = frame_rate(fps)
    encoder_of = _ENCODERS[parameters.codec]
    with av.open(str(output), "w", format=encoder_of.container, options={"movflags": "+faststart"}) as container:
        stream: Any = container.add_stream(encoder_of.name, rate=rate, options=_options(parameters))
        stream.width, stream.height = size
        stream.pix_fmt = encoder_of.pixels
        encoder = stream.codec_context
        if encoder_of.tag is not None:
            encoder.codec_tag = encoder_of.tag
        encoder.time_base = 1 / rate
        encoder.gop_size = SEGMENT_FRAMES
        encoder.thread_count = threads if parameters.codec == "h264" else 1
        _tag_bt709(encoder)
        for number, packet in enumerate(_encoded(frames, stream, encoder_of.pixels, rate)):
            if parameters.codec == "h265":
                packet.dts = number - _X265_REORDERED
            container.mux(packet)


def _encoded(frames: Iterable[Pixels], stream: Any, pixel_format: str, rate: Fraction) -> Iterator[Any]:
    """Packets of frames, in decoding order."""
    for index, pixels in enumerate(frames):
        frame = _to_yuv(pixels, pixel_format)
        frame.pts, frame.time_base = index, 1 / rate
        yield from stream.encode(frame)
    yield from stream.encode(None)


def join_segments(segments: Sequence[Path], output: Path) -> None:
    """Put segments behind each other by copying their packets; frame n of the film is at n / fps exactly.

    Args:
        segments: files by `encode_segment` with the same parameters, in order.
        output: the film to write, of the same kind.

    Raises:
        InvalidFileError: a segment is damaged, or was encoded with other parameters than the first.
        ValueError: there are no segments.
    """
    import av

    if not segments:
        raise ValueError("a film needs at least one segment")
    delay = max(_reorder_delay(segment) for segment in segments)
    with ExitStack() as stack:
        first = stack.enter_context(_opened(segments[0]))
        template = first.streams.video[0]
        container_format = "mov" if template.codec_context.name == "prores" else "mp4"
        film = stack.enter_context(
            av.open(str(output), "w", format=container_format, options={"movflags": "+faststart"})
        )
        # Opaque: without an encoder of the decoder's name, which the decoder of AV1 has none of.
        stream = film.add_stream_from_template(template, opaque=template.codec_context.name == "libdav1d")
        stream.time_base = template.time_base
        if template.codec_context.name == "hevc":
            stream.codec_context.codec_tag = template.codec_context.codec_tag
        ticks = _ticks_per_frame(segments[0], template)
        frame_count = 0
        for segment in segments:
            with _opened(segment) as container:
                source = container.streams.video[0]
                if _encoding(source) != _encoding(template):
                    raise InvalidFileError(segment, f"was not encoded as {segments[0]}")
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
        path: a film by `encode_segment` or `join_segments`.
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


def even(number: int) -> int:
    """A width or height [pixels] that the encoders take: this one, or one more."""
    return number + number % 2


def frame_rate(fps: float) -> Fraction:
    """Frames a second as the fraction that a film stores; 23.976 is 2997/125."""
    return Fraction(fps).limit_denominator(_LARGEST_RATE_DENOMINATOR)


def _options(parameters: MovieParameters) -> dict[str, str]:
    """Of FFmpeg's encoder."""
    rate, preset = {"crf": str(parameters.rate_factor)}, parameters.preset
    match parameters.codec:
        case "h264":
            return {**rate, "preset": preset, "x264-params": _X264_PARAMETERS}
        case "h265":
            return {**rate, "preset": preset, "x265-params": _X265_PARAMETERS}
        case "av1":
            os.environ["SVT_LOG"] = "1"  # errors only; it would tell its settings for every segment
            return {**rate, "preset": str(_SVT_AV1_SPEEDS[preset]), "svtav1-params": _SVT_AV1_PARAMETERS}
    return {"profile": "3"}  # 422 HQ


def _pixels(pictures: Sequence[Path], first: Pixels, read: Callable[[Path], Pixels]) -> Iterator[Pixels]:
    yield first
    for path in pictures[1:]:
        pixels = read(path)
        if pixels.shape != first.shape:
            (height, width, _), (first_height, first_width, _) = pixels.shape, first.shape
            raise InvalidFileError(
                path, f"is {width}x{height} pixels, but {pictures[0].name} is {first_width}x{first_height}"
            )
        yield pixels


def _to_yuv(pixels: Pixels, pixel_format: str) -> av.VideoFrame:
    import av
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc, Interpolation

    if pixels.dtype == np.uint8:
        picture = av.VideoFrame.from_ndarray(pixels, format="rgb24")
    else:
        # FFmpeg takes 65280 of 16 bits for white, 255 of 8 bits and 8 more; white would be 943 instead of 940.
        scaled = (pixels.astype(np.uint32) * 65280 + 32767) // 65535
        picture = av.VideoFrame.from_ndarray(scaled.astype(np.uint16), format="rgb48le")
    # Without a destination the conversion is BT.601. BITEXACT: the same pixels on every processor.
    return picture.reformat(
        format=pixel_format,
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
        raise InvalidFileError(path, f"is not an MP4 or QuickTime film: {error}") from error
    if len(container.streams.video) != 1:
        container.close()
        raise InvalidFileError(path, "has no picture track")
    return container


def _encoding(stream: Any) -> tuple[object, ...]:
    """The properties that must be equal for packets of two files to share a track."""
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
