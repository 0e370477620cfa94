"""Running experiments: trials on several processes, their records, and tables and charts of these."""
