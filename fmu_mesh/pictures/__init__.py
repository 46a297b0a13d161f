"""What people look at: graphs, plots, pages and tables."""
