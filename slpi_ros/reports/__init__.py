"""HTML pages, charts and text summaries of results."""
