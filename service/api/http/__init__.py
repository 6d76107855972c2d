"""What every resource uses: bodies, values, problems, pages, files, links, and the way from a request to a job."""
