"""Views to field: closed-form fusion and alignment of the views, and the signed distance field fitted to them."""
