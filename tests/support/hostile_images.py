"""Image files that take long to decode relative to the estimate of their structure, and a search
for them.

A `PngRecipe` or a `JpegRecipe` describes a file by the choices of its encoder: blocks and Huffman
tables of the compressed data, filters, depth, interlacing, scans, segments, sampling. The search
changes recipes at random, and continues with those whose files are accepted and take the most CPU
time relative to their estimate, so no list of known files is needed.
"""

from __future__ import annotations

import dataclasses
import random
import struct
import time
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from vlagents_ray.errors import MalformedMessage, MessageTooLarge
from vlagents_ray.images import jpeg_png
from vlagents_ray.images.image_file import PNG_MAGIC, read_structure

PIXELS = 2**20  # the limit of pixels of one image
SIZES = (1, 2, 3, 8, 16, 31, 64, 100, 128, 224, 256)
_REFUSAL_S = 20e-6, 5e-9  # estimated time to reject a file: of each file, and of each of its bytes


# Bits and Huffman codes.


def code_lengths(number: int, chain: int) -> list[int]:
    """Return the lengths of a complete prefix code: `chain` symbols of lengths 1, 2, …, and all
    others below them with about equal lengths.
    """
    chain = min(chain, number - 2, 14)
    rest = number - chain
    depth = (rest - 1).bit_length()
    while chain + depth > 15:
        chain -= 1
        rest = number - chain
        depth = (rest - 1).bit_length()
    shorter = 2**depth - rest
    return [
        *range(1, chain + 1),
        *[chain + depth - 1] * shorter,
        *[chain + depth] * (rest - shorter),
    ]


def canonical(lengths: np.ndarray) -> np.ndarray:
    """Return the canonical code of each symbol, as deflate assigns them."""
    codes = np.zeros(len(lengths), np.int64)
    code = 0
    for length in range(1, 16):
        code <<= 1
        for symbol in np.flatnonzero(lengths == length):
            codes[symbol] = code
            code += 1
    return codes


def coded(symbols: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the bits of symbols in a canonical code."""
    codes = canonical(lengths)
    sizes, values = lengths[symbols], codes[symbols]
    ends = np.cumsum(sizes)
    bits = np.zeros(int(ends[-1]) if len(ends) else 0, np.uint8)
    for bit in range(int(sizes.max(initial=0))):
        is_long = sizes > bit
        at = ends[is_long] - sizes[is_long] + bit
        bits[at] = values[is_long] >> (sizes[is_long] - 1 - bit) & 1
    return bits


def number_bits(value: int, size: int) -> list[int]:
    """Return the bits of a number as deflate stores them, the lowest first."""
    return [value >> bit & 1 for bit in range(size)]


# PNG.


def chunk(name: bytes, data: bytes) -> bytes:
    checksum = zlib.crc32(data, zlib.crc32(name))
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", checksum)


_ORDER = [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15]


def _table_bits(lengths: np.ndarray, literals: int, with_runs: bool) -> np.ndarray:
    """Return the description of the Huffman tables of a dynamic block: `lengths` of the literals,
    followed by those of the distances.
    """
    symbols: list[tuple[int, int, int]] = []  # symbol, and the value and size of its extra bits
    at = 0
    while at < len(lengths):
        run = 1
        while at + run < len(lengths) and lengths[at + run] == lengths[at]:
            run += 1
        if with_runs and lengths[at] == 0 and run >= 11:
            run = min(run, 138)
            symbols.append((18, run - 11, 7))
        elif with_runs and at and lengths[at] == lengths[at - 1] and run >= 3:
            run = min(run, 6)
            symbols.append((16, run - 3, 2))
        else:
            run = 1
            symbols.append((int(lengths[at]), 0, 0))
        at += run
    used = sorted({symbol for symbol, _, _ in symbols} | {0, 15})
    of_lengths = np.zeros(19, np.int64)
    depth = (len(used) - 1).bit_length()
    for index, symbol in enumerate(used):
        of_lengths[symbol] = depth - (index < 2**depth - len(used))
    bits = number_bits(literals - 257, 5) + number_bits(len(lengths) - literals - 1, 5)
    bits += number_bits(15, 4)
    for symbol in _ORDER:
        bits += number_bits(int(of_lengths[symbol]), 3)
    parts = [np.array(bits, np.uint8)]
    codes = canonical(of_lengths)
    for symbol, value, size in symbols:
        length = int(of_lengths[symbol])
        code = [int(codes[symbol]) >> (length - 1 - bit) & 1 for bit in range(length)]
        parts.append(np.array(code + number_bits(value, size), np.uint8))
    return np.concatenate(parts)


@dataclass(frozen=True)
class PngRecipe:
    """The choices of an encoder of PNG."""

    height: int = 64
    width: int = 64
    depth: int = 8
    colour: int = 2
    interlace: int = 0
    filters: tuple[int, ...] = (2,)
    noise: bool = False
    # "zlib", or the kind of the blocks that this module writes.
    blocks: str = "zlib"  # zlib, fixed, dynamic
    level: int = 1
    strategy: int = zlib.Z_DEFAULT_STRATEGY
    symbols: int = 4096  # symbols of a block
    codes: int = 286  # symbols with a code in the tables of a dynamic block
    chain: int = 0  # short codes in these tables
    distances: int = 30
    with_runs: bool = True  # whether runs of equal lengths are abbreviated
    data_is_short: bool = True  # whether the symbols of the data have the shortest codes
    filler: str = "none"  # blocks without symbols before the data: none, stored, fixed, dynamic
    filler_share: float = 0.0  # bytes of these, relative to the size of the rows
    idat_bytes: int = 0  # size of a chunk of data; 0 for one chunk
    chunks: int = 0  # other chunks before the data
    chunk_name: bytes = b"tEXt"
    chunk_bytes: int = 0

    def file(self) -> bytes:
        rows = self.rows()
        data = b"\x78\x01" + self._filler(len(rows)) + self._deflated(rows)
        data += struct.pack(">I", zlib.adler32(rows))
        header = struct.pack(
            ">2I5B", self.width, self.height, self.depth, self.colour, 0, 0, self.interlace
        )
        parts = [PNG_MAGIC, chunk(b"IHDR", header)]
        if self.colour == 3:
            parts.append(chunk(b"PLTE", bytes(range(48)) * 16))
        parts += [chunk(self.chunk_name, b"k\0\0" + bytes(self.chunk_bytes))] * self.chunks
        size = self.idat_bytes or len(data)
        parts += [chunk(b"IDAT", data[at : at + size]) for at in range(0, len(data), size)]
        return b"".join([*parts, chunk(b"IEND", b"")])

    def rows(self) -> bytes:
        bits = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[self.colour] * self.depth
        passes = [(self.width, self.height)]
        if self.interlace:
            passes = []
            for x, y, dx, dy in _ADAM7:
                passes.append((-(-(self.width - x) // dx), -(-(self.height - y) // dy)))
        random_bytes = np.random.default_rng(0).bytes
        rows = []
        for width, height in passes:
            size = -(-width * bits // 8)
            for row in range(height if width > 0 else 0):
                content = random_bytes(size) if self.noise else bytes(size)
                rows.append(bytes([self.filters[row % len(self.filters)]]) + content)
        return b"".join(rows)

    def _deflated(self, rows: bytes) -> bytes:
        if self.blocks == "zlib":
            packer = zlib.compressobj(self.level, zlib.DEFLATED, -15, 9, self.strategy)
            return packer.compress(rows) + packer.flush()
        symbols = np.frombuffer(rows, np.uint8).astype(np.int64)
        lengths = self._lengths(symbols) if self.blocks == "dynamic" else _FIXED
        table = self._table(lengths) if self.blocks == "dynamic" else np.zeros(0, np.uint8)
        kind = 2 if self.blocks == "dynamic" else 1
        end = coded(np.array([256]), lengths)
        size = max(1, self.symbols)
        parts = []
        for at in range(0, len(symbols), size):
            is_last = at + size >= len(symbols)
            parts += [np.array([is_last, kind & 1, kind >> 1], np.uint8), table]
            parts += [coded(symbols[at : at + size], lengths), end]
        return np.packbits(np.concatenate(parts), bitorder="little").tobytes()

    def _lengths(self, symbols: np.ndarray) -> np.ndarray:
        """Return the lengths of the codes of a dynamic block, which has codes for the data."""
        used = [*np.unique(symbols), 256]
        others = [symbol for symbol in range(286) if symbol not in used]
        chosen = used + others[: max(0, self.codes - len(used))]
        if not self.data_is_short:
            chosen.reverse()
        lengths = np.zeros(286, np.int64)
        lengths[chosen] = code_lengths(max(2, len(chosen)), self.chain)[: len(chosen)]
        return lengths

    def _table(self, lengths: np.ndarray) -> np.ndarray:
        distances = np.array(code_lengths(max(2, self.distances), 0), np.int64)
        return _table_bits(np.concatenate([lengths, distances]), len(lengths), self.with_runs)

    def _filler(self, rows_bytes: int) -> bytes:
        """Return blocks without symbols, as whole bytes."""
        share = int(self.filler_share * (rows_bytes + 1000))
        empty = b"\x00\x00\x00\xff\xff"  # a stored block, which begins at the next byte
        if self.filler == "none" or not share:
            return b""
        if self.filler == "stored":
            return empty * (share // len(empty))
        if self.filler == "fixed":
            block = np.concatenate([np.array([0, 1, 0], np.uint8), np.zeros(7, np.uint8)])
        else:
            lengths = self._lengths(np.zeros(1, np.int64))
            end = coded(np.array([256]), lengths)
            block = np.concatenate([np.array([0, 0, 1], np.uint8), self._table(lengths), end])
        bits = np.tile(block, max(1, 8 * share // len(block)))
        bits = np.concatenate([bits, np.zeros(3, np.uint8)])  # the beginning of the stored block
        return np.packbits(bits, bitorder="little").tobytes() + empty[1:]


_ADAM7 = (
    (0, 0, 8, 8),
    (4, 0, 8, 8),
    (0, 4, 4, 8),
    (2, 0, 4, 4),
    (0, 2, 2, 4),
    (1, 0, 2, 2),
    (0, 1, 1, 2),
)
_FIXED = np.array([8] * 144 + [9] * 112 + [7] * 24 + [8] * 8, np.int64)

PNG_CHOICES: dict[str, tuple[Any, ...]] = {
    "height": (*SIZES, 4000),
    "width": (*SIZES, 4000),
    "depth": (1, 2, 4, 8, 8, 8, 16),
    "colour": (0, 2, 3, 4, 6),
    "interlace": (0, 0, 1),
    "filters": ((0,), (1,), (2,), (3,), (4,), (2, 4), (1, 2, 3, 4)),
    "noise": (False, True),
    "blocks": ("zlib", "fixed", "dynamic"),
    "level": (0, 1, 6, 9),
    "strategy": (
        zlib.Z_DEFAULT_STRATEGY,
        zlib.Z_FILTERED,
        zlib.Z_HUFFMAN_ONLY,
        zlib.Z_RLE,
        zlib.Z_FIXED,
    ),
    "symbols": (1, 4, 16, 31, 64, 256, 4096, 10**6),
    "codes": (2, 3, 16, 64, 257, 286),
    "chain": (0, 1, 2, 4, 8, 14),
    "distances": (2, 16, 30),
    "with_runs": (False, True),
    "data_is_short": (False, True),
    "filler": ("none", "stored", "fixed", "dynamic"),
    "filler_share": (0.0, 0.01, 0.1, 0.5, 0.9, 1.9),
    "idat_bytes": (0, 0, 0, 1, 7, 100, 4096),
    "chunks": (0, 0, 0, 1, 10, 60, 250),
    "chunk_name": (b"tEXt", b"zTXt", b"iCCP", b"abCd", b"gAMA", b"IDAT", b"PLTE"),
    "chunk_bytes": (0, 0, 100, 2000),
}


# JPEG.


def segment(marker: int, data: bytes) -> bytes:
    return bytes((0xFF, marker)) + struct.pack(">H", len(data) + 2) + data


def stuffed(bits: np.ndarray) -> bytes:
    """Return bits as the bytes of a scan, filled up with ones."""
    padded = np.concatenate([bits, np.ones(-len(bits) % 8, np.uint8)])
    return np.packbits(padded).tobytes().replace(b"\xff", b"\xff\0")


def _huffman(kind: int, symbols: list[int], bits: int) -> tuple[bytes, dict[int, list[int]]]:
    """Return the segment of a Huffman table in which the last symbols have codes of `bits`, and the
    codes.
    """
    chain = max(0, bits - (len(symbols)).bit_length())
    unused = 0x11 if kind & 0x10 else 1  # symbols of the short codes
    names = [*range(unused, unused + chain), *symbols]
    depth = len(symbols).bit_length()  # room for one more code, since no code is all ones
    counts = [0] * 16
    codes: dict[int, list[int]] = {}
    for position in range(chain):
        counts[position] = 1
        codes[names[position]] = [1] * position + [0]
    counts[chain + depth - 1] = len(symbols)
    for index, symbol in enumerate(symbols):
        codes[symbol] = [1] * chain + [index >> (depth - 1 - bit) & 1 for bit in range(depth)]
    return segment(0xC4, bytes([kind]) + bytes(counts) + bytes(names)), codes


@dataclass(frozen=True)
class JpegRecipe:
    """The choices of an encoder of JPEG."""

    height: int = 64
    width: int = 64
    process: int = 0xC0
    precision: int = 8
    sampling: tuple[int, ...] = (0x11,)
    code_bits: int = 3  # length of the codes of the data
    coefficients: int = 0  # coefficients of a block that are not zero
    size: int = 1  # bits of each of them
    ones: bool = False  # whether they are positive
    restart: int = 0  # units between two restart markers; 0 for none
    more_restarts: int = 0  # restart markers of each that are wrong
    interleaved: bool = True
    scans: int = 1
    refining: bool = False  # whether further scans refine
    segments: int = 0
    segment: str = "comment"  # comment, tables, profile, exif
    segment_bytes: int = 0
    are_behind: bool = False  # whether these segments follow the scan
    fill: int = 0  # fill bytes before a marker
    trailing: int = 0  # bytes behind the end
    headers: int = 1

    def file(self) -> bytes:
        dc, dc_codes = _huffman(0x00, [0], max(1, min(self.code_bits, 8)))
        ac_symbols = [0x00, self.size, 0xE0]
        ac, ac_codes = _huffman(0x10, ac_symbols, self.code_bits)
        tables = segment(0xDB, b"\0" + b"\1" * 64) + dc + ac
        frame = self._frame()
        more = self._segments(tables)
        parts = [b"\xff\xd8", tables, *([] if self.are_behind else more), b"\xff" * self.fill]
        parts += [frame] * self.headers
        if self.restart:
            parts.append(segment(0xDD, struct.pack(">H", self.restart)))
        parts += self._scans(dc_codes, ac_codes)
        parts += more if self.are_behind else []
        return b"".join([*parts, b"\xff\xd9", bytes(self.trailing)])

    def _frame(self) -> bytes:
        components = b""
        for index, factors in enumerate(self.sampling):
            components += bytes((index + 1, factors, 0))
        header = struct.pack(">BHHB", self.precision, self.height, self.width, len(self.sampling))
        return segment(self.process, header + components)

    def _segments(self, tables: bytes) -> list[bytes]:
        data = bytes(self.segment_bytes)
        one = {
            "comment": segment(0xFE, data),
            "tables": tables,
            "profile": segment(0xE2, b"ICC_PROFILE\0\1\1" + data),
            "exif": segment(0xE1, b"Exif\0\0" + data),
        }[self.segment]
        return [one] * self.segments

    def _scans(
        self, dc_codes: dict[int, list[int]], ac_codes: dict[int, list[int]]
    ) -> Iterator[bytes]:
        names = range(1, len(self.sampling) + 1)
        horizontal = max(factors >> 4 for factors in self.sampling)
        vertical = max(factors & 15 for factors in self.sampling)
        units = -(-self.width // (8 * horizontal)) * -(-self.height // (8 * vertical))
        per_unit = sum((factors >> 4) * (factors & 15) for factors in self.sampling)
        is_progressive = self.process in (0xC2, 0xCA)
        block = [*dc_codes[0]]
        if not is_progressive:
            coefficient = [*ac_codes[self.size], *[int(self.ones)] * self.size]
            block += coefficient * self.coefficients
            block += ac_codes[0] if self.coefficients < 63 else []
        unit = np.array(block * per_unit, np.uint8)
        groups = [list(names)] if self.interleaved else [[name] for name in names]
        for group in groups:
            ids = b"".join(bytes((name, 0)) for name in group)
            last = 0 if is_progressive else 63
            head = segment(0xDA, bytes((len(group),)) + ids + bytes((0, last, 0)))
            yield head + self._data(unit, units)
        blocks = -(-self.width // 8) * -(-self.height // 8)
        skipped = number_bits_high(max(0, blocks - 2**14), 14)
        for index in range(self.scans - 1):
            high, low = (13 - index % 13, 12 - index % 13) if self.refining else (0, 0)
            band = bytes((1, 1, 0, 1 if is_progressive else 0, 63, high << 4 | low))
            yield segment(0xDA, band) + stuffed(np.array([*ac_codes[0xE0], *skipped], np.uint8))

    def _data(self, unit: np.ndarray, units: int) -> bytes:
        if not self.restart:
            return stuffed(np.tile(unit, units))
        piece = stuffed(np.tile(unit, self.restart))
        data = []
        for number in range(-(-units // self.restart)):
            marker = bytes((0xFF, 0xD0 | number % 8))
            data.append(piece + marker * (1 + self.more_restarts))
        return b"".join(data)[:-2]


def number_bits_high(value: int, size: int) -> list[int]:
    """Return the bits of a number, the highest first."""
    return number_bits(value, size)[::-1]


JPEG_CHOICES: dict[str, tuple[Any, ...]] = {
    "height": (*SIZES, 512, 4000),
    "width": (*SIZES, 512, 4000),
    "process": (0xC0, 0xC0, 0xC0, 0xC1, 0xC2, 0xC9, 0xCA),
    "precision": (8, 8, 8, 12),
    "sampling": (
        (0x11,),
        (0x44,),
        (0x11, 0x11, 0x11),
        (0x22, 0x11, 0x11),
        (0x21, 0x11, 0x11),
        (0x12, 0x11, 0x11),
        (0x41, 0x11, 0x11),
        (0x14, 0x11, 0x11),
        (0x11, 0x22, 0x22),
        (0x11, 0x11, 0x11, 0x11),
        (0x22, 0x11, 0x11, 0x22),
    ),
    "code_bits": (2, 3, 8, 9, 12, 15, 16),
    "coefficients": (0, 1, 8, 32, 62, 63),
    "size": (1, 2, 5, 10),
    "ones": (False, True),
    "restart": (0, 0, 1, 2, 8, 100),
    "more_restarts": (0, 0, 1, 20),
    "interleaved": (True, True, False),
    "scans": (1, 1, 2, 10, 98, 200),
    "refining": (False, True),
    "segments": (0, 0, 1, 10, 50, 60, 250),
    "segment": ("comment", "tables", "profile", "exif"),
    "segment_bytes": (0, 0, 100, 1000, 60_000),
    "are_behind": (False, False, True),
    "fill": (0, 0, 1, 1000, 60_000),
    "trailing": (0, 0, 1000, 60_000),
    "headers": (1, 1, 1, 2),
}


# The search.


@dataclass(frozen=True)
class Played:
    """A file that was decoded or rejected."""

    recipe: PngRecipe | JpegRecipe
    accepted: bool  # whether its structure was accepted
    ratio: float  # CPU time relative to the estimate

    def __str__(self) -> str:
        changed = []
        for field in dataclasses.fields(self.recipe):
            value = getattr(self.recipe, field.name)
            if value != field.default:
                changed.append(f"{field.name}={value!r}")
        kind = type(self.recipe).__name__
        verdict = "accepted" if self.accepted else "rejected"
        return f"{self.ratio:.1f} times its estimate, {verdict}: {kind}({', '.join(changed)})"


def cpu_and_estimate_s(file: bytes, rounds: int = 2) -> tuple[float, float, bool]:
    """Return the CPU time in which a file is decoded or rejected, its estimate, s, and whether its
    structure is accepted. Without an accepted structure, the estimate is that of a rejection.
    """
    estimate_s, accepted = _REFUSAL_S[0] + _REFUSAL_S[1] * len(file), False
    times = []
    for _ in range(rounds):
        begun = time.thread_time()
        try:
            structure = read_structure(file, PIXELS)
            estimate_s, accepted = structure.decoding_s, True
            jpeg_png.decode_file(structure)
        except (MalformedMessage, MessageTooLarge):
            pass
        times.append(time.thread_time() - begun)
    return min(times), estimate_s, accepted


def played(recipe: PngRecipe | JpegRecipe, rounds: int = 2) -> Played:
    cpu_s, estimate_s, accepted = cpu_and_estimate_s(recipe.file(), rounds)
    return Played(recipe, accepted, cpu_s / estimate_s)


Recipe = TypeVar("Recipe", PngRecipe, JpegRecipe)
_KEPT = 12  # recipes from which the search continues
_MOST_PIXELS = 2**16  # larger files take longer to write and to decode, in the same proportion


def changed(recipe: Recipe, choices: dict[str, tuple[Any, ...]], random_: random.Random) -> Recipe:
    """Return a recipe with one to three other choices."""
    names = random_.sample(sorted(choices), random_.choice((1, 1, 2, 3)))
    return dataclasses.replace(recipe, **{name: random_.choice(choices[name]) for name in names})


def search(
    first: Recipe,
    choices: dict[str, tuple[Any, ...]],
    number: int,
    seed: int,
    least_pixels: int = 1,
) -> list[Played]:
    """Play `number` files of at least `least_pixels`, and return them, the worst first.

    Each file changes one of the worst accepted files so far, or, once in four times, any recipe.
    """
    random_ = random.Random(seed)
    found = [played(first)]
    tried = {first}
    while len(found) < number:
        if random_.random() < 0.25:
            base = dataclasses.replace(
                first, **{name: random_.choice(choices[name]) for name in choices}
            )
        else:
            base = random_.choice(found[:_KEPT]).recipe
        recipe = changed(base, choices, random_)
        pixels = recipe.height * recipe.width
        if recipe in tried or not least_pixels <= pixels <= _MOST_PIXELS:
            continue
        tried.add(recipe)
        found.append(played(recipe))
        found.sort(key=lambda one: (one.accepted, one.ratio), reverse=True)
    return found


# A file of each format that the search once found, for floods: PNG data that are mostly Huffman
# tables, and a JPEG of long codes.
WORST = {
    "PNG": PngRecipe(128, 128, level=9, filler="dynamic", filler_share=0.9),
    "JPEG": JpegRecipe(code_bits=16, coefficients=63),
}
