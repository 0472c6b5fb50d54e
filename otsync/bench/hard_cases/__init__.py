"""The catalogue of hard cases: one table for every solver of a slot; ``docs/stability.md`` shows it."""
