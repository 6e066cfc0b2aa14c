"""Every table and figure of chapter 4, from records alone; figure 3.1 from saved models."""
