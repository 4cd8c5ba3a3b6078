"""Everything that reads or writes: bags, tables, messages, documents."""
