"""Registration of a scan against a map: associations, residuals, robust weights and the Gauss-Newton loop."""
