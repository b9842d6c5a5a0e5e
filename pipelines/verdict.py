"""What became of a step: each verdict with its sentence.

A bad measurement is a verdict, a bad call an exception. A step has one `verdict`, the gravest of
its `alarms`; the alarms are a set of flags, so that nothing that was noticed is lost.
"""

from __future__ import annotations

import enum
import functools


class Severity(enum.IntEnum):
    """How much a verdict should worry the reader."""

    FINE = 0
    NOTICE = 1
    WARNING = 2
    ERROR = 3


class Verdict(enum.IntFlag):
    """The outcome of one step; values are stable and are written into recordings.

    The order of gravity is that of the severities, then of the values.
    """

    OK = 0
    FIRST_FRAME = 1 << 0
    REACQUIRED = 1 << 1
    CORRECTION_APPLIED = 1 << 2
    DUPLICATE_FRAME = 1 << 3
    FRAME_GAP = 1 << 4
    HEIGHT_CHANGE = 1 << 5
    EXPOSURE_JUMP = 1 << 6
    BLURRED = 1 << 7
    PEAK_AMBIGUOUS = 1 << 8
    PEAK_AT_BORDER = 1 << 9
    LOW_CORRELATION = 1 << 10
    LOW_TEXTURE = 1 << 11
    APERTURE = 1 << 12
    RESIDUAL_HIGH = 1 << 13
    ROTATION_BEYOND_LIMIT = 1 << 14
    SUBPIXEL_DIVERGED = 1 << 15
    SEARCH_OUTSIDE_IMAGE = 1 << 16
    NOT_RIGID = 1 << 17
    TOO_FEW_INLIERS = 1 << 18
    OUT_OF_ORDER = 1 << 19
    SIZE_CHANGED = 1 << 20
    UNDECODABLE = 1 << 21
    LOST = 1 << 22
    LANDMARK_REJECTED = 1 << 23
    LANDMARK_RESET = 1 << 24
    LANDMARK_LOST = 1 << 25
    NO_LANDMARKS = 1 << 26
    RANGE_UNKNOWN = 1 << 27
    LOW_PARALLAX = 1 << 28
    NEAR_FOCUS = 1 << 29
    PURE_ROTATION = 1 << 30
    STANDSTILL = 1 << 31
    NIS_HIGH = 1 << 32
    NIS_LOW = 1 << 33
    INNOVATIONS_ONE_SIDED = 1 << 34
    INNOVATIONS_ALTERNATE = 1 << 35
    INNOVATIONS_FOLLOW_TURN = 1 << 36
    INPUT_STALE = 1 << 37
    INPUT_MISSING = 1 << 38
    INPUT_OUT_OF_ORDER = 1 << 39
    INPUT_UNREADABLE = 1 << 40
    STARTING = 1 << 41
    SCALE_UNKNOWN = 1 << 42
    SCALE_DRIFT = 1 << 43
    FEW_POINTS = 1 << 44
    POINTS_DROPPED = 1 << 45
    ALIGNMENT_FAILED = 1 << 46
    RELOCALISED = 1 << 47
    AFTER_RELOCALISATION = 1 << 48
    NEW_MAP = 1 << 49
    POINTS_UNLIKE = 1 << 50

    @property
    def sentence(self) -> str:
        """What this verdict says, in words, for one flag."""
        return _SENTENCES[self]

    @property
    def severity(self) -> Severity:
        """How grave this verdict is, for one flag."""
        return _SEVERITIES.get(self, Severity.WARNING)


_SENTENCES: dict[Verdict, str] = {
    Verdict.OK: "every check passed",
    Verdict.FIRST_FRAME: "first frame: nothing to compare with yet",
    Verdict.REACQUIRED: "position found again by the global search",
    Verdict.CORRECTION_APPLIED: "a segment's correction was applied",
    Verdict.DUPLICATE_FRAME: "the frame repeats the one before it, pixel by pixel",
    Verdict.FRAME_GAP: "frames are missing: the time since the last one is a multiple of the usual",
    Verdict.HEIGHT_CHANGE: "the matches lie closer together or further apart than the fragments: the height changed",
    Verdict.EXPOSURE_JUMP: "the mean grey level jumped since the frame before",
    Verdict.BLURRED: "sharpness fell below its running median and the match lost contrast: the frame is blurred",
    Verdict.PEAK_AMBIGUOUS: "the second correlation peak is nearly as high as the first",
    Verdict.PEAK_AT_BORDER: "the correlation peak lies at the border of the search area",
    Verdict.LOW_CORRELATION: "the correlation peak is low",
    Verdict.LOW_TEXTURE: "the fragment has too little texture for a shift to be told",
    Verdict.APERTURE: "the texture is striped: the shift along the stripes is uncertain",
    Verdict.RESIDUAL_HIGH: "what remains after matching is far above its running median",
    Verdict.ROTATION_BEYOND_LIMIT: "the rotation between frames is beyond the limit of (1) for this fragment size",
    Verdict.SUBPIXEL_DIVERGED: "the subpixel step is longer than its limit: the system is ill-conditioned",
    Verdict.SEARCH_OUTSIDE_IMAGE: "a search area lies outside the image",
    Verdict.NOT_RIGID: "the fragments' shifts do not fit one rigid motion",
    Verdict.TOO_FEW_INLIERS: "too few fragments agree on a motion",
    Verdict.OUT_OF_ORDER: "the frame's stamp does not lie after the one before it; the frame was skipped",
    Verdict.SIZE_CHANGED: "the image size differs from that of the frame before",
    Verdict.UNDECODABLE: "the image could not be decoded",
    Verdict.LOST: "no position: what was last known is held until it is found again",
    Verdict.LANDMARK_REJECTED: "an image point lies outside the gate of its landmark and was not used",
    Verdict.LANDMARK_RESET: "a landmark's image points were rejected several times in a row: its range starts again",
    Verdict.LANDMARK_LOST: "a landmark was given up: it was not seen for long, or came behind the camera",
    Verdict.NO_LANDMARKS: "no landmark has an image point in this frame",
    Verdict.RANGE_UNKNOWN: "no landmark's range counts yet",
    Verdict.LOW_PARALLAX: "the way has hardly moved any landmark on the image: the ranges are those of the start",
    Verdict.NEAR_FOCUS: "a landmark lies near the focus of expansion, where driving tells nothing of its range",
    Verdict.PURE_ROTATION: "the landmarks moved on the image by rotation alone, which tells nothing of their ranges",
    Verdict.STANDSTILL: "the camera stands: the ranges stay as they are",
    Verdict.NIS_HIGH: "the innovations are larger than the filter expects: noise settings, start, stamps or inputs",
    Verdict.NIS_LOW: "the innovations are smaller than the filter expects: its noise settings are too large",
    Verdict.INNOVATIONS_ONE_SIDED: "a landmark's innovations keep one sign: its start is wrong and trusted too much",
    Verdict.INNOVATIONS_ALTERNATE: "the innovations alternate in sign: stamps or frames are swapped",
    Verdict.INNOVATIONS_FOLLOW_TURN: "the innovations in x follow the rate of turn: the images' stamps are off",
    Verdict.INPUT_STALE: "the last speed or rate of turn is old; it is held",
    Verdict.INPUT_MISSING: "there is no speed or no rate of turn yet: landmarks cannot be carried on",
    Verdict.INPUT_OUT_OF_ORDER: "a speed or rate of turn came late: after a later one, or after its frame",
    Verdict.INPUT_UNREADABLE: "a message with a speed or rate of turn could not be used",
    Verdict.STARTING: "no map yet: corners are followed until the camera has moved far enough",
    Verdict.SCALE_UNKNOWN: "nothing told the scale: lengths are in units of the first map's depth",
    Verdict.SCALE_DRIFT: "the height over the map differs from the sensor's: the scale has drifted",
    Verdict.FEW_POINTS: "too few map points were found in the frame",
    Verdict.POINTS_DROPPED: "far fewer map points were found than in the frame before",
    Verdict.ALIGNMENT_FAILED: "the sparse alignment had too few patches or no solution",
    Verdict.RELOCALISED: "found again by a keyframe of the map",
    Verdict.AFTER_RELOCALISATION: "the path was lost before: how it continues the path up to there is not sure",
    Verdict.NEW_MAP: "a new map was begun: its place and scale do not continue the path before",
    Verdict.POINTS_UNLIKE: "the map points neither agree well nor look like their patches: this is another place",
}

_SEVERITIES: dict[Verdict, Severity] = {
    Verdict.OK: Severity.FINE,
    Verdict.FIRST_FRAME: Severity.NOTICE,
    Verdict.REACQUIRED: Severity.NOTICE,
    Verdict.CORRECTION_APPLIED: Severity.FINE,
    Verdict.NOT_RIGID: Severity.ERROR,
    Verdict.TOO_FEW_INLIERS: Severity.ERROR,
    Verdict.OUT_OF_ORDER: Severity.ERROR,
    Verdict.SIZE_CHANGED: Severity.ERROR,
    Verdict.UNDECODABLE: Severity.ERROR,
    Verdict.LOST: Severity.ERROR,
    Verdict.LANDMARK_LOST: Severity.NOTICE,
    Verdict.RANGE_UNKNOWN: Severity.NOTICE,
    Verdict.LOW_PARALLAX: Severity.NOTICE,
    Verdict.NEAR_FOCUS: Severity.NOTICE,
    Verdict.STANDSTILL: Severity.NOTICE,
    Verdict.INPUT_MISSING: Severity.ERROR,
    Verdict.STARTING: Severity.NOTICE,
    Verdict.SCALE_UNKNOWN: Severity.NOTICE,
    Verdict.AFTER_RELOCALISATION: Severity.NOTICE,
}


@functools.cache
def flags(alarms: Verdict) -> tuple[Verdict, ...]:
    """The single flags of a set of alarms, gravest first; empty for `Verdict.OK`."""
    single = [v for v in Verdict if v in alarms]
    return tuple(sorted(single, key=lambda v: (v.severity, v.value), reverse=True))


@functools.cache
def gravest(alarms: Verdict) -> Verdict:
    """The gravest single flag of a set of alarms, `Verdict.OK` for the empty set."""
    single = flags(alarms)
    return single[0] if single else Verdict.OK
