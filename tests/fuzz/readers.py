"""Every reader of files that somebody else may have written."""

from __future__ import annotations

from . import binaries, exchange, layouts, maps, records, texts

TARGETS = [*records.TARGETS, *texts.TARGETS, *binaries.TARGETS, *layouts.TARGETS, *exchange.TARGETS, *maps.TARGETS]
