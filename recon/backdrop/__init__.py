"""The backdrop, which stands still: pictures of it, seeds for it, and its own fit."""
