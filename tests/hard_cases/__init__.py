"""The catalogue of hard cases: one table that every solver runs, and that ``docs/stability.md`` is made from."""
