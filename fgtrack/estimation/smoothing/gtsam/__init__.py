"""Windows that gtsam solves as factor graphs: the only importer of gtsam."""
