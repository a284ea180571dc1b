"""Whether this machine renders the bits of a round: digests of two frames of a public scene of each family."""

from collections.abc import Iterable

from dynslam_bench.core import RunError, find_data_root
from dynslam_bench.rounds.files import Round
from dynslam_bench.sequences.synthetic import open_synthetic
from dynslam_bench.sequences.synthetic.digests import probe_digest, rendered_digest
from dynslam_bench.sequences.synthetic.ids import probe_id


def probe_digests(families: Iterable[str]) -> dict[str, str]:
    """The digests of public scenes as this machine renders them, by the scene's id; nothing stored is read."""
    return {probe: probe_digest(probe) for probe in map(probe_id, families)}


def check_bits(of: Round) -> None:
    """Check that this machine renders what the organiser's does.

    Raises:
        RunError: A public scene has other bits here.
    """
    for sequence, digest in probe_digests(of.families).items():
        stated = of.probes.get(sequence, "")
        if digest != stated:
            raise RunError(
                f"this machine renders other bits: {sequence} has the digest {digest[:16]}, "
                f"round {of.name} has {stated[:16] or 'none'}",
                "errors would be those of other scenes; use another machine, and report this one",
            )


def scene_digest(sequence: str) -> str:
    """The digest of a whole scene as this machine renders it; frames that are stored are read."""
    return rendered_digest(open_synthetic(sequence, find_data_root()))
