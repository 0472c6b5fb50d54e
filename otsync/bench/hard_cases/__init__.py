"""The catalogue of hard cases: one table that every solver of a slot runs, ours and others'; ``docs/stability.md`` shows it."""
