"""Reading and writing of bags, tables, messages and documents."""
