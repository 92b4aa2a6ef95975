"""Messages of any robots over the shared medium: pure code (`transport`, `settings`) and a node (`node`)."""
